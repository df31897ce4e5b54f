"""The covariance of a pose against the pose errors of many noisy problems."""

import pytest
import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from laws import PAIRS, Case, make, make_bad
from torch.utils import _pytree as pytree

from kornia_pnpnet import PnPResult, Pose, PosePrior, create_solver, pose_covariance
from kornia_pnpnet.data import OutlierMix, SyntheticProblems


def tangent(estimate, truth):
    """(omega, v) of the estimate from the truth."""
    turn = rotation_matrix_to_axis_angle(estimate.rotation @ truth.rotation.mT)
    return torch.cat((turn, estimate.translation - truth.translation), -1)


def test_zero_weight_equals_removing(make_problems):
    """Such pairs may hold any numbers."""
    p = make_problems(n=12, batch=5)
    weights = (torch.arange(12) < 8).double().expand(5, 12)
    world, sigma = p.world_points.clone(), torch.full((5, 12), 2.0, dtype=torch.float64)
    world[:, 8:], sigma[:, 8:] = torch.nan, torch.nan
    half = pose_covariance(p.pose, world, *p[1:3], img_sigma=sigma, weights=weights)
    part = pose_covariance(p.pose, p.world_points[:, :8], p.img_points[:, :8], p.intrinsics, img_sigma=2.0)
    torch.testing.assert_close(half, part)


def test_units_of_the_noise(make_problems):
    """A number, one per problem or one per pair; twice the noise is four times the covariance."""
    p = make_problems(n=12, batch=5)
    plain = pose_covariance(p.pose, *p[:3], img_sigma=1.0, world_sigma=0.1)
    double = pose_covariance(
        p.pose, *p[:3], img_sigma=p.world_points.new_full((5,), 2.0), world_sigma=p.world_points.new_full((5, 12), 0.2)
    )
    torch.testing.assert_close(double, 4.0 * plain)
    scaled = Pose(p.pose.rotation, 1000.0 * p.pose.translation)
    large = pose_covariance(scaled, 1000.0 * p.world_points, *p[1:3], img_sigma=1.0, world_sigma=100.0)
    unit = torch.tensor([1.0] * 3 + [1000.0] * 3, dtype=torch.float64)
    torch.testing.assert_close(large, plain * unit * unit[:, None])


@pytest.mark.parametrize("noise", ["sigma", "covariance"])
def test_an_undetermined_pose_has_infinite_variances_and_no_gradient(noise):
    """And changes no other covariance."""
    case = Case("epnp-lm", noise=noise)
    kinds, sound, bad = make_bad(case)
    _, pose = make(case, len(sound["weights"]))
    leaves = [x.requires_grad_() for x in bad.values()]
    found, expected = pose_covariance(pose, **bad), pose_covariance(pose, **sound)
    assert torch.equal(found[::2], expected[::2])
    assert expected.isfinite().all()
    infinite = torch.diag(torch.full((6,), torch.inf, dtype=torch.float64))
    assert torch.equal(found[1::2], infinite.expand(len(kinds), 6, 6)), kinds
    for gradient in torch.autograd.grad(found[::2].sum(), leaves):
        assert gradient.isfinite().all()
        assert not gradient[1::2].any()


@pytest.mark.parametrize(("n", "outliers"), [(12, 0), (20, 5)])
def test_covariances_from_the_weights_of_the_shipped_network(n, outliers):
    """The mean normalised squared errors are those of chi-square: 6 for the pose, 3 for each half."""
    data = SyntheticProblems(n=n, batch_size=2000, seed=9, outliers=OutlierMix(count=outliers), dtype=torch.float64)
    p = data.batch(0)
    noise = {"img_sigma": 1.0, "world_sigma": 0.05}
    result = create_solver("pnpnet-set").double()(*p[:3], **noise)
    covariance = pose_covariance(result.pose, *p[:3], **noise, weights=result.weights)
    error = tangent(result.pose, p.pose)
    for part, freedom, tolerance in ((slice(0, 6), 6.0, 0.06), (slice(0, 3), 3.0, 0.1), (slice(3, 6), 3.0, 0.1)):
        squares = (error[:, part] * torch.linalg.solve(covariance[:, part, part], error[:, part])).sum(-1)
        assert squares.mean().item() == pytest.approx(freedom, rel=tolerance)


@pytest.mark.parametrize(("n", "img_sigma", "world_sigma"), [(20, 1.0, 0.05), (50, 2.0, 0.0), (30, 0.0, 0.02)])
def test_noise_that_nobody_gave_is_that_of_the_residuals(n, img_sigma, world_sigma):
    """Whether the pixels or the points have noise, as :func:`pose_covariance` of the true noise within a third."""
    data = SyntheticProblems(
        n=n, batch_size=500, seed=10, img_sigma=img_sigma, world_sigma=world_sigma, dtype=torch.float64
    )
    p = data.batch(0)
    result = create_solver("pnpnet-set").double()(*p[:3])
    covariance = result.covariance(*p[:3])
    error = tangent(result.pose, p.pose)[result.ok]
    squares = (error * torch.linalg.solve(covariance[result.ok], error)).sum(-1)
    assert squares.mean().item() == pytest.approx(6.0, rel=0.33)
    alone = PnPResult(*(x[0] if isinstance(x, torch.Tensor) else x for x in result))
    torch.testing.assert_close(alone.covariance(*(x[0] for x in p[:3])), covariance[0])


@pytest.mark.parametrize("case", [Case("epnp-lm", noise="sigma"), Case("epnp-lm", noise="covariance", extra="prior")])
def test_gradients(case):
    """By all inputs. As in ``laws.gradcheck`` each of them moves relative to its own size."""
    call, pose = make(case, 1)
    call |= {"pose": pose, "weights": torch.linspace(0.1, 0.9, PAIRS, dtype=torch.float64)[None]}
    leaves, spec = pytree.tree_flatten(call)
    sizes = [x.abs().mean() if x.shape[1:] in ((PAIRS, 2), (PAIRS, 3)) else x for x in leaves]

    def run(*changes):
        moved = [x + size * d for x, size, d in zip(leaves, sizes, changes, strict=True)]
        return pose_covariance(**pytree.tree_unflatten(moved, spec))

    changes = [torch.zeros_like(x).requires_grad_() for x in leaves]
    assert torch.autograd.gradcheck(run, changes, eps=1e-6, atol=1e-6, rtol=1e-3, fast_mode=True)


def test_an_unknown_focal_length_is_that_of_the_result(make_problems):
    """The solver's call may give any focal length; the covariance of the pose is not computed with it."""
    p = make_problems(n=20, batch=3)
    nominal = p.intrinsics / torch.tensor([3400.0, 3400.0, 1.0]).double()[:, None]
    result = create_solver("p3p-ransac", focal="unknown")(*p[:2], nominal, img_sigma=1.0)
    assert result.ok.all()
    noise = {"img_sigma": 1.0, "focal": "unknown"}
    weights = result.inliers.double()
    expected = pose_covariance(result.pose, *p[:2], result.intrinsics, **noise, weights=weights)
    assert expected.isfinite().all()
    torch.testing.assert_close(result.covariance(*p[:2], nominal, **noise), expected)
    assert pose_covariance(result.pose, *p[:2], nominal, **noise).diagonal(dim1=1, dim2=2).isinf().all()


def test_a_prior_adds_its_information(make_problems):
    p = make_problems(n=8, batch=5)
    far = p._replace(world_points=p.world_points + 100.0)  # in the frame of the caller, not of the centroid
    pose = Pose(p.pose.rotation, p.pose.translation - (p.pose.rotation @ torch.full((3,), 100.0, dtype=torch.float64)))
    information = torch.diag(torch.tensor([1e3, 2e3, 3e3, 4.0, 5.0, 6.0], dtype=torch.float64)).expand(5, 6, 6)
    given = pose, *far[:3]
    alone = pose_covariance(*given, img_sigma=1.0)
    found = pose_covariance(*given, img_sigma=1.0, prior=PosePrior(pose, information))
    torch.testing.assert_close(torch.linalg.inv(found), torch.linalg.inv(alone) + information, rtol=1e-6, atol=1e-3)
