"""Confidences of pairs: fitted to scores as the how-to page says, and beside weights made of them."""

from __future__ import annotations

import pytest
import torch
from helpers import rate

from kornia_pnpnet import create_solver, pose_errors
from kornia_pnpnet.data import OutlierMix, SyntheticProblems


def ratios(inliers, generator):
    """Ratios of the distances to the nearest and the second nearest descriptor: lower is better."""
    uniform = torch.rand(inliers.shape, generator=generator)
    return torch.where(inliers, 0.45 + 0.55 * uniform, 1.0 - 0.4 * uniform**2)


def test_fitted_confidences_find_poses_among_many_outliers(generator):
    isotonic = pytest.importorskip("sklearn.isotonic")
    known, problems = (
        SyntheticProblems(n=100, batch_size=60, seed=seed, world_sigma=0.0, outliers=OutlierMix(count=88)).batch(0)
        for seed in (1, 2)
    )
    calibration = isotonic.IsotonicRegression(y_min=0.01, y_max=0.99, increasing="auto", out_of_bounds="clip")
    calibration.fit(ratios(known.inliers, generator).ravel(), known.inliers.ravel())
    scores = ratios(problems.inliers, generator)
    fitted = torch.from_numpy(calibration.predict(scores.ravel())).reshape(scores.shape).float()
    solver = create_solver("p3p-ransac", max_samples=300)
    rates = {}
    for name, confidence in {"none": None, "raw": 1.0 - scores, "fitted": fitted}.items():
        with torch.no_grad():
            rates[name] = rate(solver(*problems[:3], confidence=confidence), problems, max_translation=0.5)
    assert rates["fitted"] > rates["none"] + 0.15, rates
    assert rates["fitted"] > rates["raw"] + 0.05, rates


@pytest.mark.parametrize("power", [0.0, 1.5, 3.0])
def test_confidence_is_at_least_as_good_as_weights_made_of_it(power, generator):
    """Keypoints as a network finds them: less accurate (``power``) and more often wrong where it is less confident."""
    problems = SyntheticProblems(n=11, batch_size=500, seed=31, img_sigma=0.0, world_sigma=0.0).batch(0)
    confidence = torch.rand(500, 11, generator=generator) ** 0.4
    noise = torch.randn(2, 500, 11, 2, generator=generator)
    pixels = problems.img_points + confidence.clamp(min=0.05)[..., None] ** -power * noise[0]
    elsewhere = problems.img_points.roll(1, 1) + 50.0 * noise[1]
    inliers = torch.rand(500, 11, generator=generator) < 0.98 * confidence.sqrt()
    pixels = torch.where(inliers[..., None], pixels, elsewhere)
    errors = {}
    for name, values in {"confidence": confidence, "weights": confidence**6, "mask": inliers | True}.items():
        with torch.no_grad():
            found = create_solver("pnpnet-set")(problems[0], pixels, problems[2], **{name: values})
        errors[name] = pose_errors(found.pose, problems.pose).rotation_error_deg.clamp(max=10.0).mean()
    assert errors["confidence"] < errors["weights"]
    assert errors["confidence"] < (0.75 if power == 3.0 else 1.02) * errors["mask"]
