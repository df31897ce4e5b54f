"""Confidences of pairs: fitted to scores as the how-to page says, and beside weights made of them."""

from __future__ import annotations

import pytest
import torch

from kornia_pnpnet import create_solver, pose_errors, success
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
            errors = pose_errors(solver(*problems[:3], confidence=confidence).pose, problems.pose)
        rates[name] = success(errors, max_translation=0.5).double().mean().item()
    assert rates["fitted"] > rates["none"] + 0.15, rates
    assert rates["fitted"] > rates["raw"] + 0.05, rates


def keypoints(power, generator, batch=500, n=11):
    """Keypoints as a network finds them: less accurate (``power``) and more often wrong where it is less confident."""
    problems = SyntheticProblems(n=n, batch_size=batch, seed=31, img_sigma=0.0, world_sigma=0.0).batch(0)
    confidence = torch.rand(batch, n, generator=generator) ** 0.4
    sigma = confidence.clamp(min=0.05) ** -power
    pixels = problems.img_points + sigma[..., None] * torch.randn(batch, n, 2, generator=generator)
    elsewhere = pixels.roll(1, 1) + 50.0 * torch.randn(batch, n, 2, generator=generator)
    inliers = torch.rand(batch, n, generator=generator) < 0.98 * confidence.sqrt()
    return problems._replace(img_points=torch.where(inliers[..., None], pixels, elsewhere), inliers=inliers), confidence


@pytest.mark.parametrize("power", [0.0, 1.5, 3.0])
def test_confidence_is_at_least_as_good_as_weights_made_of_it(power, generator):
    problems, confidence = keypoints(power, generator)
    solver, given = create_solver("pnpnet-set"), problems[:3]
    options = {"confidence": {"confidence": confidence}, "weights": {"weights": confidence**6}, "nothing": {}}
    errors = {}
    with torch.no_grad():
        for name, option in options.items():
            rotation, _ = pose_errors(solver(*given, **option).pose, problems.pose)
            errors[name] = rotation.clamp(max=10.0).mean()
    assert errors["confidence"] < errors["weights"]
    assert errors["confidence"] < (0.75 if power == 3.0 else 1.02) * errors["nothing"]
