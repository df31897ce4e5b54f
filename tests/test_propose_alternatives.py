"""Other poses: the mirror image of a plane, the solutions of three pairs; none where there is one minimum."""

import math

import pytest
import torch
from kornia.core.exceptions import BaseError

from kornia_pnpnet import Pose, Status, create_solver, p3p, pose_errors, success
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.judge.evidence import LEAST_PROBABILITY

NAMES = ["pnpnet-set", "epnp-lm", "reppnp-lm", "p3p-ransac"]


def boards(generator, batch=60, tilt=40.0, sigma=0.0, dtype=torch.float64):
    """A board of nine points, tilted, from far away: its mirror image projects to almost the same pixels."""
    side = torch.linspace(-0.1, 0.1, 3, dtype=dtype)
    world = torch.cat((torch.cartesian_prod(side, side), torch.zeros(9, 1, dtype=dtype)), 1).expand(batch, 9, 3)
    azimuth, x, y = torch.rand(3, batch, generator=generator, dtype=dtype)
    azimuth = 2.0 * math.pi * azimuth
    axis = torch.stack((azimuth.cos(), azimuth.sin(), 0.0 * azimuth), -1) * math.radians(tilt)
    pose = Pose.from_rvec(axis, torch.stack((0.5 * x, 0.5 * y, 2.5 + x), -1))
    camera = torch.tensor([[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]], dtype=dtype)
    seen = (world @ pose.rotation.mT + pose.translation[:, None]) @ camera.mT
    noise = sigma * torch.randn(batch, 9, 2, generator=generator, dtype=dtype)
    return world, seen[..., :2] / seen[..., 2:] + noise, camera.expand(batch, 3, 3), pose


def answers(result):
    """The pose and the alternatives of a result, and which of them there are."""
    found = result.alternatives
    others = [Pose(*x) for x in zip(found.rotation.unbind(1), found.translation.unbind(1), strict=True)]
    return [result.pose, *others], [torch.ones_like(result.ok), *found.valid.unbind(1)]


@pytest.mark.parametrize("name", NAMES)
def test_the_right_pose_of_a_board_is_among_them(name, generator):
    *given, pose = boards(generator, sigma=0.7)
    result = create_solver(name)(*given, alternatives=2)
    found, (poses, valid) = result.alternatives, answers(result)
    right = torch.stack([success(pose_errors(x, pose), 15.0, 0.3) for x in poses]) & torch.stack(valid)
    assert right.any(0).double().mean() > max(0.9, right[0].double().mean())
    assert found.rotation.shape == (60, 2, 3, 3)
    there = found.valid
    assert there[:, 0].double().mean() > 0.5
    assert (there[:, 0] | ~there[:, 1]).all()
    assert (found.probability[:, 1] <= found.probability[:, 0])[there[:, 1]].all()
    assert ((found.probability > 0) == there).all()
    assert (found.probability.sum(1) < 1).all()
    assert torch.equal(found.rotation[~there], torch.eye(3, dtype=torch.float64).expand(int((~there).sum()), 3, 3))
    for other, is_there in zip(poses[1:], valid[1:], strict=True):
        assert (pose_errors(other, result.pose).rotation_error_deg > 1.9)[is_there].all()


def test_a_pose_is_not_believed_beside_its_mirror_image(generator):
    *given, pose = boards(generator, batch=300, sigma=0.7, dtype=torch.float32)
    believed = {}
    for effort in ("fixed", "adaptive"):
        result = create_solver("pnpnet-set", effort=effort)(*given)
        error = pose_errors(result.pose, pose).rotation_error_deg
        believed[effort] = result.ok[error > 10.0].double().mean(), result.ok[error < 5.0].double().mean()
        assert (result.status[~result.ok] != 0).all()
        assert (result.probability[result.ok] >= LEAST_PROBABILITY).all()
    assert believed["fixed"][0] > 0.5
    assert believed["adaptive"][0] < 0.5
    assert believed["adaptive"][1] > 0.7


def test_a_board_seen_from_the_front(generator):
    """The mirror image is often no minimum; the tilt is then as uncertain as the image says."""
    *given, pose = boards(generator, batch=200, tilt=8.0, sigma=1.0)
    result = create_solver("pnpnet-set")(*given, img_sigma=1.0, world_sigma=0.0, alternatives=1)
    poses, (_, valid) = answers(result)
    assert valid.double().mean() > 0.6
    first, other = (pose_errors(x, pose).rotation_error_deg < 8.0 for x in poses)
    assert (first | (other & valid)).double().mean() > first.double().mean() + 0.1
    # The line of sight to the middle stays where it is.
    middle = given[0].mean(1)
    seen = [(x.rotation @ middle[..., None])[..., 0] + x.translation for x in (poses[1], pose)]
    angle = torch.nn.functional.cosine_similarity(*seen, dim=-1)[valid].clamp(max=1.0).acos()
    assert (angle < math.radians(0.3)).all()


def test_the_solutions_of_three_pairs(make_problems):
    problems = make_problems(n=3, batch=50, noise=False)
    plane = (problems.img_points - problems.intrinsics[:, None, :2, 2]) / problems.intrinsics[:, None, [0, 1], [0, 1]]
    every, valid = p3p(problems.world_points, plane)
    result, other = (create_solver(x)(*problems[:3], alternatives=3) for x in ("pnpnet-set", "p3p-ransac"))
    assert (torch.cat((result.status, other.status)) == Status.NOT_BELIEVED).all()
    seen = torch.zeros_like(valid)
    for pose, there in zip(*answers(result), strict=True):
        for i in range(4):
            errors = pose_errors(Pose(every.rotation[:, i], every.translation[:, i]), pose)
            close = success(errors, 3.0, 0.05 * pose.translation.norm(dim=-1))
            seen[:, i] |= there & close
    assert (seen | ~valid).double().mean() > 0.95


@pytest.mark.parametrize("name", NAMES)
def test_none_where_the_pairs_say_enough(name, make_problems):
    problems = make_problems(n=50, batch=20)
    solver = create_solver(name, **({"threshold": 20.0} if name == "p3p-ransac" else {}))
    expected, result = solver(*problems[:3]), solver(*problems[:3], alternatives=3)
    assert expected.alternatives.valid.shape == (20, 0)
    assert not result.alternatives.valid.any()
    assert torch.equal(result.matrix, expected.matrix)


def test_padding_bad_problems_and_gradients(generator):
    world, img, camera, _ = boards(generator, batch=6, sigma=1.0)
    solver = create_solver("pnpnet-set")
    whole = solver(world, img, camera, alternatives=2)
    padded = [torch.nn.functional.pad(x, (0, 0, 0, 3)) for x in (world, img)]
    masked = solver(*padded, camera, mask=(torch.arange(12) < 9).expand(6, 12), alternatives=2)
    broken = img.clone()
    broken[1, 0, 0] = torch.nan
    bad = solver(world, broken, camera, alternatives=2)
    keep = [0, 2, 3, 4, 5]
    for other in (bad.alternatives.rotation, masked.alternatives.rotation):
        torch.testing.assert_close(other[keep], whole.alternatives.rotation[keep], atol=1e-6, rtol=0)
    with pytest.raises(BaseError, match="alternatives"):
        solver(world, img, camera, alternatives=-1)
    gradients = []
    for alternatives in (0, 2):
        pixels = img.clone().requires_grad_()
        result = solver(world, pixels, camera, alternatives=alternatives)
        gradients.append(torch.autograd.grad(result.translation.sum(), pixels)[0])
    assert torch.equal(*gradients)
    assert not result.alternatives.rotation.requires_grad


def test_problems_whose_noise_was_underestimated_have_alternatives():
    """Their second solution takes the place of the first one, and the other poses are found for every problem."""
    p = SyntheticProblems(n=30, batch_size=20, seed=5, img_sigma=40.0, world_sigma=0.0).batch(0)
    solver = create_solver("pnpnet-set")
    expected, result = solver(*p[:3]), solver(*p[:3], alternatives=2)
    assert result.matrix.equal(expected.matrix)
    assert result.alternatives.valid.shape == (20, 2)
