r"""The first guess of a rig: RANSAC on the exact cameras, since networks and EPnP know one pinhole camera."""

from __future__ import annotations

import torch

from kornia_pnpnet.core.performance import problems_last
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.geometry import project
from kornia_pnpnet.init.ransac import P3P, RANSAC
from kornia_pnpnet.normalize import F_CONST
from kornia_pnpnet.refine.verdict import residual_noise
from kornia_pnpnet.types import Correspondences, Guess, Pose

__all__ = ["guess_of_rig"]

# Focal lengths. Threshold of an inlier: ten times the noise of a pixel at a focal length of 1000 pixels.
_THRESHOLD = 0.01
_FINDER = RANSAC(P3P(), threshold=_THRESHOLD * F_CONST)


def guess_of_rig(corr: Correspondences, given: Pose | None, *, with_noise: bool) -> Guess:
    """Find the pose of a rig, its inliers and their noise.

    Args:
        corr: normalised correspondences of a rig.
        given: a pose that competes with those of the samples.
        with_noise: estimate the noise of the pixels from the residuals, for a refinement that expects it.

    Returns:
        The guess, a constant.
    """
    corr = corr.map(torch.Tensor.detach)
    with torch.no_grad():
        guess = _FINDER(corr._replace(img_scale=corr.focal.expand(len(corr.weights)) / F_CONST), given)
        noise = None
        if with_noise:
            pairs = problems_last(corr)
            noise = residual_noise(project(guess.pose, pairs), pairs, guess.weights)
            noise = map_tensors(torch.Tensor.contiguous, noise)
            if corr.noise is not None:
                told = corr.noise
                noise = noise._replace(
                    img=torch.where(told.img.isnan(), noise.img, told.img),
                    world=torch.where(told.world.isnan(), noise.world, told.world),
                )
    return guess._replace(ok=None, noise=noise, weights=(guess.weights > 0).to(guess.weights))
