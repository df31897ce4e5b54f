"""Each usual mistake is named, and right input is left alone."""

import pytest
import torch

from kornia_pnpnet import Pose, diagnose

CENTRE = torch.tensor([330.0, 235.0])
SIZE = torch.tensor([640.0, 480.0])
FLIPS = {"flip y", "mirror the world"}


def camera(focal=800.0, centre=CENTRE):
    return torch.tensor([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])


def problem(pairs=40, outliers=10, batch=(), depth=4.0):
    """Points, pixels with a noise of 0.5 px and outliers, and the pose."""
    generator = torch.Generator().manual_seed(pairs)
    pixels = torch.rand(*batch, pairs, 2, generator=generator) * SIZE
    z = 4.0 + depth * torch.rand(*batch, pairs, 1, generator=generator)
    pose = Pose.from_rvec(torch.tensor([[0.3, -0.4, 0.9]]), torch.tensor([[0.2, 0.3, 6.0]]))
    points = (torch.cat(((pixels - CENTRE) / 800.0, torch.ones_like(z)), -1) * z - pose.translation) @ pose.rotation[0]
    pixels = pixels + 0.5 * torch.randn(pixels.shape, generator=generator)
    pixels[..., :outliers, :] = pixels[..., :outliers, :].roll(1, -2)
    return points, pixels, Pose(*(x[0].expand(*batch, *x.shape[1:]) for x in pose))


def changes(found):
    return {trial.change for trial in found.best}


UP, Z = torch.tensor([1.0, -1.0]), torch.tensor([1.0, -1.0, 1.0])
#: What was done to points, pixels and camera, and the changes that may be named.
MISTAKES = {
    "none": (lambda x, u: (x, u, camera()), {"as given"}),
    "wrong scale": (lambda x, u: (1e3 * x, u, 2.0 * camera()), {"as given"}),
    "swapped": (lambda x, u: (x, u.flip(-1), camera()), {"swap u and v"}),
    "y up": (lambda x, u: (x, SIZE * torch.tensor([0.0, 1.0]) + UP * u, camera()), FLIPS),
    "left-handed": (lambda x, u: (x * Z, u, camera()), FLIPS),
    "principal point 0": (
        lambda x, u: (x, u, camera(centre=0.0 * CENTRE)),
        {"set the principal point to half the image size"},
    ),
    "centred pixels": (lambda x, u: (x, u - CENTRE, camera()), {"set the principal point to 0"}),
    "focal length too long": (lambda x, u: (x, u, camera(1600.0)), {"halve the focal length"}),
    "focal length too short": (lambda x, u: (x, u, camera(400.0)), {"double the focal length"}),
    "smaller image": (lambda x, u: (x, u / 2.0, camera()), {"halve the intrinsics (resized image)"}),
    "larger image": (lambda x, u: (x, 2.0 * u, camera()), {"double the intrinsics (resized image)"}),
    "normalised": (
        lambda x, u: (x, (u - CENTRE) / 800.0, camera()),
        {"multiply normalised coordinates by the intrinsics"},
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
@pytest.mark.parametrize("batch", [(), (2, 1)], ids=str)
def test_the_mistake_is_named(name, batch):
    points, pixels, _ = problem(batch=batch)
    spoil, expected = MISTAKES[name]
    found = diagnose(*spoil(points, pixels))
    assert changes(found) <= expected
    (best, *_) = found.best
    assert best.agree == pytest.approx(0.75, abs=0.06)
    assert best.sigma < 1.5


def test_a_given_pose_is_tried_as_its_inverse():
    points, pixels, pose = problem()
    inverse = Pose(pose.rotation.mT, -(pose.rotation.mT @ pose.translation))
    other = Pose(torch.eye(3), torch.tensor([0.0, 0.0, 6.0]))
    for given, expected in ((pose, "as given"), (inverse, "invert the pose"), (other, "find another pose")):
        assert changes(diagnose(points, pixels, camera(), pose=given)) == {expected}
    assert changes(diagnose(points * Z, pixels, camera(), pose=pose)) <= FLIPS


def test_random_pairs_have_no_diagnosis():
    points, pixels, _ = problem(outliers=40)
    found = diagnose(points, pixels[torch.randperm(40, generator=torch.Generator().manual_seed(0))], camera())
    assert found.best == ()
    invalid = diagnose(points, pixels, torch.zeros(3, 3))
    assert invalid.best == ()
