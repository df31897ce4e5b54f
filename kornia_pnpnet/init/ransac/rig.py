r"""Minimal solver of three pairs that several cameras of a rig see, or one camera in any direction."""

from __future__ import annotations

import torch
from torch.nn import functional

from kornia_pnpnet.cameras import bearing_cameras
from kornia_pnpnet.core.checks import check_whole
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.performance import problems_last
from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.geometry import project
from kornia_pnpnet.init.ransac.p3p import p3p
from kornia_pnpnet.init.ransac.search import least_squares
from kornia_pnpnet.types import Correspondences, Hypotheses, Pose

__all__ = ["P3PRig", "is_central"]


class P3PRig(Configured):
    r"""Minimal solver of three pairs of a rig: the central approximation, then Newton's method on the exact equations.

    The central approximation lets all rays meet at the mean of the cameras' centres; :func:`p3p` solves it. From its
    up to four poses Newton's method finds poses of the exact problem, of which there are up to eight (D. Nistér,
    "A minimal solution to the generalised 3-point pose problem", CVPR 2004).

    Args:
        steps: number of Newton's steps; 0 where all centres coincide.
    """

    #: Number of pairs in a sample.
    sample_size = 3

    def __init__(self, steps: int = 8) -> None:
        super().__init__(locals())
        check_whole(0, steps=steps)
        self.steps = steps

    def hypotheses(self, corr: Correspondences) -> Hypotheses:
        r"""Solve samples of three pairs.

        Args:
            corr: normalised correspondences of a rig with :math:`N = 3`. Their weights are ignored.

        Returns:
            Four slots per sample, without gradients. Samples whose rays are more than 90 degrees from their mean have
            none.

        Raises:
            ShapeError: when :math:`N` is not 3.
        """
        assert corr.rig is not None
        batch = len(corr.weights)
        rays = functional.normalize(corr.places, dim=-1)  # (B, 3, 3) in the frame of the rig
        centre = -(corr.rig.rotation * corr.rig.translation[..., None]).sum(-2).mean(1)  # (B, 3)
        turn, _ = bearing_cameras(rays.sum(1, keepdim=True))
        turn = turn[:, 0]
        seen = rays @ turn.mT
        ahead = seen[..., 2:]
        plane = torch.where(ahead > 0, seen[..., :2] / ahead, torch.inf)
        solved = p3p(corr.world_points, plane)
        slot, at = solved.valid.mT.nonzero(as_tuple=True)  # the batch stays last in memory
        back = turn[at].mT
        found = map_tensors(lambda x: x.transpose(0, 1)[slot, at], solved.pose)
        pose = Pose(back @ found.rotation, (back @ found.translation[..., None])[..., 0] + centre[at])
        if self.steps:
            pairs = problems_last(take(corr, at))
            pairs = pairs._replace(weights=torch.ones_like(pairs.weights))  # three pairs have exact solutions
            for _ in range(self.steps):
                pose = least_squares(pairs, pose, project(pose, pairs), pairs.weights).pose
        finite = pose.rotation.isfinite().all(-1).all(-1) & pose.translation.isfinite().all(-1)
        slot, at, pose = slot[finite], at[finite], map_tensors(lambda x: x[finite], pose)
        rotation = torch.eye(3, dtype=rays.dtype, device=rays.device).repeat(4, batch, 1, 1)
        translation, valid = rays.new_zeros(4, batch, 3), torch.zeros_like(solved.valid.mT)
        rotation[slot, at], translation[slot, at], valid[slot, at] = *pose, True
        return Hypotheses(Pose(rotation.transpose(0, 1), translation.transpose(0, 1)), valid.mT)


def is_central(rig: Pose) -> bool:
    """Whether all centres are the rig's origin, as those of bearings."""
    return not bool(rig.translation.any())
