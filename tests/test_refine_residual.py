"""Laws of the residual, its normal equations and the retraction."""

import math

import pytest
import torch
from helpers import assert_same, verified_derivative
from kornia.geometry.conversions import axis_angle_to_rotation_matrix

from kornia_pnpnet import Pose
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.data import CameraProblems
from kornia_pnpnet.problem import Problem, State
from kornia_pnpnet.refine import residual
from kornia_pnpnet.refine.residual import normal_equations, project, retract

FOCAL, RADIAL = 3400.0, torch.tensor([[0.05, -0.02]], dtype=torch.float64)


def scene(camera, unknown, turn):
    """Points in front of cameras but for one, and a state with unknown parameters of the camera."""
    options = {"cameras": 1 if camera == "pixels" else 3, "baseline": 0.1 if camera == "rig" else 0.0}
    p = CameraProblems(n=9, batch_size=7, seed=0, dtype=torch.float64, **options).batch(0)
    if p.cam_from_rig is not None:  # whose cameras turn about one axis
        rig = p.cam_from_rig._replace(rotation=p.cam_from_rig.rotation @ turn.mT[:, None])
        pose = Pose(turn @ p.pose.rotation, (turn @ p.pose.translation[..., None])[..., 0])
        p = p._replace(pose=pose, cam_from_rig=rig)
    to_camera = p.pose.rotation if p.cam_from_rig is None else p.cam_from_rig.rotation[:, 0] @ p.pose.rotation
    p.world_points[0, 0] -= 1000.0 * to_camera[0, 2]  # to the far side of the camera
    known = torch.cat((torch.linspace(-0.1, 0.1, 7).double()[:, None], RADIAL.expand(7, 2)), 1)[:, :unknown]
    return State(p.pose, known), Problem.of(p.world_points, p.img_points - 1000.0, FOCAL, rig=p.cam_from_rig)


@pytest.mark.parametrize("few", [True, False])
@pytest.mark.parametrize(
    ("camera", "unknown"), [("pixels", 0), ("rig", 0), ("bearings", 0), *(("pixels", k) for k in (1, 2, 3))]
)
def test_normal_equations_are_those_of_the_derivative(camera, unknown, few, random_rotations, monkeypatch, generator):
    """Both forms of them, for weights and for matrices as weights."""
    state, problem = scene(camera, unknown, random_rotations(7))
    jacobian = verified_derivative(lambda x: project(x, problem).residual.flatten(0, 1).mT, state).unflatten(1, (2, 9))
    projection = project(state, problem)
    assert projection.in_front.sum() == 62
    monkeypatch.setattr(residual, "are_few", lambda _: few)
    root = torch.randn(7, 9, 2, 2, generator=generator, dtype=torch.float64)
    for matrices in (root @ root.mT, torch.eye(2) * root[..., :1, :1].square()):
        is_scalar = not matrices[..., 0, 1].any()
        weights = matrices[..., 0, 0] if is_scalar else Symmetric2.of(matrices)
        found = normal_equations(projection, problem, weights)
        left = torch.einsum("buni,bnuv->bvni", jacobian, matrices * projection.in_front[..., None, None])
        focal = projection.focal.expand(7)
        matrix = torch.einsum("bvni,bvnj->ijb", left, jacobian) / focal**2
        gradient = torch.einsum("bvni,vnb->ib", left, projection.residual) / focal
        size = matrix.diagonal().mT.sqrt()
        assert ((found.matrix - matrix) / (size[:, None] * size)).abs().max() < 1e-10
        assert ((found.gradient - gradient) / size).abs().max() < 1e-8 * FOCAL


def test_points_behind_the_camera_have_finite_gradients():
    world = torch.tensor([[[1.0, 2.0, z] for z in (-1.0, 0.0, 1e-30, 5.0)]], requires_grad=True)
    for unknown in (0, 3):
        state = State(Pose(torch.eye(3)[None], torch.zeros(1, 3)), torch.zeros(1, unknown, requires_grad=True))
        projection = project(state, Problem.of(world, torch.zeros(1, 4, 2), 1000.0))
        assert projection.in_front.tolist() == [[False, False, False, True]]
        leaves = [world, state.camera] if unknown else [world]
        assert all(x.isfinite().all() for x in torch.autograd.grad(projection.residual.sum(), leaves))


# --- rotations ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [0.0, 1e-12, 1e-3, 0.03, 1.0, 1e6])
def test_retraction_is_cayleys(length, random_rotations, generator):
    """It turns about its axis by 2 arctan(length / 2); the opposite one undoes it."""
    delta = torch.randn(50, 6, generator=generator, dtype=torch.float64)
    delta = delta / delta[:, :3].norm(dim=-1, keepdim=True)
    pose = Pose(random_rotations(50), torch.zeros(50, 3).double())
    there = retract(pose, length * delta)
    expected = axis_angle_to_rotation_matrix(2.0 * math.atan(0.5 * length) * delta[:, :3]) @ pose.rotation
    assert_same(there.rotation, expected, atol=1e-14)
    assert_same(there.translation, length * delta[:, 3:])
    back = retract(there, -length * delta)
    assert_same(back.rotation, pose.rotation, atol=1e-13)
    assert_same(back.translation, pose.translation, atol=1e-14 * max(length, 1.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-3, 1.0, 1e3, 1e15])
def test_retraction_by_anything_is_a_rotation_with_finite_gradients(length, dtype, random_rotations, generator):
    delta = (length * torch.randn(50, 6, generator=generator)).to(dtype).requires_grad_()
    there = retract(Pose(random_rotations(50).to(dtype), torch.zeros(50, 3, dtype=dtype)), delta)
    eye = torch.eye(3, dtype=dtype).expand(50, 3, 3)
    assert_same(there.rotation @ there.rotation.mT, eye, atol=20 * torch.finfo(dtype).eps)
    assert (torch.linalg.det(there.rotation) > 0.5).all()
    there.rotation.sum().backward()
    assert delta.grad.isfinite().all()
