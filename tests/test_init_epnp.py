"""EPnP: laws, the minimum of its objective, gradients, and OpenCV's EPnP beside it."""

from __future__ import annotations

import pytest
import torch

from kornia_pnpnet import Correspondences, Normalize, PnPNet, Pose, RobustWeightedLM
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.geometry import transform
from kornia_pnpnet.init.epnp.control_points import control_points
from kornia_pnpnet.init.epnp.depths import depth_system, four_cases, minimize
from kornia_pnpnet.init.epnp.epnp import EPnP
from kornia_pnpnet.metrics import pose_errors, success

DTYPES = (torch.float32, torch.float64)


class Plane:
    """Points of a square in a random plane in front of the camera."""

    def __call__(self, batch_size, n, generator):
        def uniform(*shape):
            return torch.rand(batch_size, *shape, generator=generator, dtype=torch.float64) - 0.5

        axes = torch.linalg.qr(uniform(3, 2)).Q
        centre = torch.tensor([0.0, 0.0, 40.0], dtype=torch.float64)
        return 20.0 * uniform(n, 2) @ axes.mT + 10.0 * uniform(1, 3) + centre


def problems(n, batch=50, *, planar=False, noise=True, seed=2001, dtype=torch.float64):
    noises = {} if noise else {"img_sigma": 0.0, "world_sigma": 0.0}
    if noise and planar:
        noises = {"world_sigma": 0.0}
    points = Plane() if planar else None
    return SyntheticProblems(n=n, batch_size=batch, seed=seed, points=points, dtype=dtype, **noises).batch(0)


def solver(**arguments):
    return PnPNet(EPnP(**arguments), RobustWeightedLM(m=0, robustness=0))


def correspondences(p, **normalization):
    normalize = Normalize(order=False, **normalization)
    return normalize(p.world_points, p.img_points, p.intrinsics)[0]


def test_four_and_five_exact_pairs_work_through_the_null_space():
    for n, planar, share in ((5, False, 1.0), (5, True, 1.0), (4, True, 1.0), (4, False, 0.85)):
        p = problems(n, 500, planar=planar, noise=False)
        result = solver()(*p[:3])
        assert (pose_errors(result.pose, p.pose).rotation_error_deg < 1e-4).double().mean() >= share


@pytest.mark.parametrize("thickness", [1e-2, 1e-3, 1e-8, 0.0])
def test_nearly_planar_points_are_solved_on_either_side_of_the_threshold(thickness):
    p = problems(9, 200, planar=True, noise=False)
    bump = torch.randn(p.world_points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    world = p.world_points + 10.0 * thickness * bump
    cam = transform(p.pose, world)
    img = p.intrinsics[:, :1, 0, None] * cam[..., :2] / cam[..., 2:]
    result = solver()(world, img, p.intrinsics)
    # Below the threshold the thickness is dropped and acts as noise of that size.
    tolerance = 1e-6 if thickness in (1e-2, 0.0) else 1.0
    assert (pose_errors(result.pose, p.pose).rotation_error_deg < tolerance).double().mean() >= 0.98


def reference_equations(corr):
    """The same objective from the 12 by 12 matrix of the paper: residuals of depths (4,), and K."""
    control = control_points(corr)
    a, w = control.coordinates, control.weights[..., None]
    u, v = ((corr.img_points / corr.focal).unbind(-1)[i][..., None] for i in range(2))
    zero = torch.zeros_like(a)
    rows = torch.cat((torch.cat((a, zero, -u * a), -1), torch.cat((zero, a, -v * a), -1)), 1)  # (B, 2N, 12)
    M = rows.mT @ (torch.cat((w, w), 1) * rows)
    camera = torch.cat((-torch.linalg.solve(M[:, :8, :8], M[:, :8, 8:]), torch.eye(4).double().expand(len(a), 4, 4)), 1)
    K = camera.mT @ M @ camera
    L = control.points[:, 1:].mT
    unit = L.square().sum((1, 2)).sqrt()[:, None, None]
    return camera.unflatten(1, (3, 4)), K, L / unit


def reference_minimum(corr, weight):
    """The least value of the objective by Levenberg-Marquardt from eigenvectors of K."""
    camera, K, L = reference_equations(corr)
    gram = L.mT @ L
    root = torch.linalg.cholesky(K + 1e-15 * torch.eye(4)).mT

    def residual(camera, root, gram, z):
        D = (camera @ z)[:, 1:]
        return torch.cat(((D.mT @ D - gram).flatten(), weight**0.5 * root @ z))

    values = torch.func.vmap(residual)
    slopes = torch.func.vmap(torch.func.jacrev(residual, argnums=3))
    best = torch.full((len(K),), torch.inf, dtype=torch.float64)
    vectors = torch.linalg.eigh(K).eigenvectors
    for z in (vectors[..., 0], vectors[..., 0] + vectors[..., 1], vectors[..., 0] - vectors[..., 1]):
        z = z / z[:, :1] * 2.0
        damping = torch.full_like(z[:, :1], 1e-3)
        for _ in range(60):
            r, J = values(camera, root, gram, z), slopes(camera, root, gram, z)
            normal = J.mT @ J
            step = torch.linalg.solve(normal + torch.diag_embed(damping * torch.ones_like(z)), J.mT @ r[..., None])
            moved = z - step[..., 0]
            better = values(camera, root, gram, moved).square().sum(-1) < r.square().sum(-1)
            z = torch.where(better[:, None], moved, z)
            damping = torch.where(better[:, None], 0.1 * damping, 10.0 * damping).clamp(1e-15, 1e6)
        best = torch.minimum(best, values(camera, root, gram, z).square().sum(-1))
    return best


@pytest.mark.parametrize(("n", "weight"), [(6, 0.3), (9, 0.0), (20, 0.3)])
def test_the_minimum_is_that_of_the_twelve_unknowns(n, weight):
    corr = correspondences(problems(n, 200))
    control = control_points(corr)
    system = depth_system(control, (corr.img_points / corr.focal).permute(2, 1, 0))
    camera, K, L = reference_equations(corr)
    torch.testing.assert_close(system.error.permute(2, 0, 1), K, rtol=0, atol=1e-12)
    torch.testing.assert_close(system.first.permute(2, 0, 1), camera[:, 0], rtol=0, atol=1e-12)
    torch.testing.assert_close(system.gram.permute(2, 0, 1), L.mT @ L, rtol=0, atol=1e-12)
    cases = minimize(system, four_cases(system), weight, 8)  # (4, 4, B)
    values = []
    for z in cases.permute(1, 2, 0):
        D = (camera @ z[:, None, :, None])[:, :, 1:, 0]
        algebraic = (z[:, None] @ K @ z[..., None])[:, 0, 0]
        values.append((D.mT @ D - L.mT @ L).square().sum((1, 2)) + weight * algebraic)
    reached = torch.stack(values).amin(0) <= reference_minimum(corr, weight) * (1 + 1e-6) + 1e-14
    assert reached.double().mean() >= 0.995


@pytest.mark.parametrize(("n", "planar"), [(5, False), (9, True)])
def test_gradcheck_through_the_solver(n, planar):
    p = problems(n, 1, planar=planar, seed=2005)
    net = solver(iterations=8)
    assert net(*p[:3]).ok.all()

    # All inputs near 1, so that one difference step suits all; only the four free entries of the intrinsics.
    def run(world, pixels, entries, weights):
        (fx, fy, cx, cy), zero = entries.unbind(-1), torch.zeros_like(entries[:, 0])
        rows = torch.stack((fx, zero, cx, zero, fy, cy, zero, zero, zero + 1e-3), -1)
        result = net(world, 1000.0 * pixels, 1000.0 * rows.unflatten(-1, (3, 3)), weights)
        return result.rotation, result.translation

    entries = torch.tensor([3.4, 3.4, 0.1, -0.1], dtype=torch.float64)[None]
    shift = torch.tensor([0.1, -0.1], dtype=torch.float64)
    weights = 0.5 + torch.rand(1, n, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    inputs = [x.clone().requires_grad_() for x in (p.world_points, p.img_points / 1000.0 + shift, entries, weights)]
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-5, rtol=1e-4)


SQUARE = torch.tensor([[[-1, -1], [1, -1], [-1, 1], [1, 1], [2, 0], [-2, 0]]], dtype=torch.float64)


def parallel_plane(plane):
    """Correspondences of a plane parallel to the image at the distance 4, with a gradient in the pixels."""
    world = torch.cat((plane, torch.zeros_like(plane[..., :1])), -1)
    pixels = (plane / 4.0).requires_grad_()
    return Correspondences(world, pixels, torch.ones_like(world[..., 0]), torch.ones((), dtype=plane.dtype))


@pytest.mark.parametrize("plane", [SQUARE, SQUARE[:, :4], SQUARE + 0.1 * SQUARE.square()], ids=["six", "four", "odd"])
def test_a_plane_parallel_to_the_image_has_a_gradient(plane):
    """There the depth of the third control vector is free in the equations, but not in the problem."""
    corr = parallel_plane(plane)
    guess = EPnP(iterations=8)(corr)
    assert guess.ok.all()
    torch.testing.assert_close(guess.pose.translation, torch.tensor([[0.0, 0.0, 4.0]]).double(), rtol=0, atol=1e-9)
    guess.pose.translation[0, 2].backward()
    # Pixels that grow together come from a camera that is closer: d(1/z) = dz / z.
    growth = (corr.img_points.grad * corr.img_points.detach()).sum()
    torch.testing.assert_close(growth, torch.tensor(-4.0).double(), rtol=1e-6, atol=0)


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("n", [4, 6, 9, 50])
def test_success_is_at_least_opencvs(n, planar):
    cv2 = pytest.importorskip("cv2")
    p = problems(n, 1000, planar=planar, seed=2002)
    rotation, translation = torch.eye(3).double().repeat(1000, 1, 1), torch.zeros(1000, 3, dtype=torch.float64)
    for i, (world, img, camera) in enumerate(zip(*(x.numpy() for x in p[:3]), strict=True)):
        found, turn, shift = cv2.solvePnP(world, img, camera, None, flags=cv2.SOLVEPNP_EPNP)
        if found:
            rotation[i], translation[i] = torch.from_numpy(cv2.Rodrigues(turn)[0]), torch.from_numpy(shift[:, 0])
    theirs = success(pose_errors(Pose(rotation, translation), p.pose)).double().mean()
    assert success(pose_errors(solver()(*p[:3]).pose, p.pose)).double().mean() >= theirs - 0.01
