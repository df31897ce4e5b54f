"""Whether a pose is to be believed: its inliers (:mod:`~kornia_pnpnet.judge.inliers`), and what they are worth
(:mod:`~kornia_pnpnet.judge.belief`)."""
