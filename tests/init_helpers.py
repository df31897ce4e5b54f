"""What the tests of the linear initialisers share."""

import torch


def change(corr, **changes):
    """Other pairs, without the scales of the normalisation."""
    return corr._replace(img_scale=None, world_scale=None, **changes)


def flattened(corr, truth):
    """The same pairs with the world points moved along their rays onto a slanted plane."""
    normal = torch.tensor([0.2, -0.3, 1.0], dtype=torch.float64)
    rays = torch.nn.functional.pad(corr.img_points / corr.focal, (0, 1), value=1.0)
    cam_points = rays * (2.0 / (rays @ normal))[..., None]
    return change(corr, world_points=(cam_points - truth.translation[:, None]) @ truth.rotation)


def assert_same(got, expected, tolerance=1e-7):
    torch.testing.assert_close(got.rotation, expected.rotation, rtol=0, atol=tolerance)
    torch.testing.assert_close(got.translation, expected.translation, rtol=tolerance, atol=tolerance)
