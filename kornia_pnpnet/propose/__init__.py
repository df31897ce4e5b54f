"""Initialisers: from a problem in the solver's frame to the poses from which refinement starts.

A new initialiser is one new file here: a subclass of :class:`~kornia_pnpnet.propose.initialiser.Initialiser`, whose
``forward`` maps a :class:`~kornia_pnpnet.problem.Problem` to :class:`~kornia_pnpnet.problem.Starts`. Class attributes
say what a solver must know of it:

- ``pairs_at_once``: number of pairs per core whose temporaries stay in the caches. A solver splits larger batches where
  gradients allow it. ``None``: never.
- ``fixed_pairs``: every problem must have the same number of pairs, in a fixed order.
- ``takes_given``: poses that the caller gives compete with its own hypotheses inside the initialiser.
- ``takes_rigs``: it solves problems of a rig.
- ``estimates_noise``: ``Starts.noise`` holds an estimate where the noise is unknown.
- ``weighs_unusual``: its weights say which pairs that are not of normal scale are inliers. The weights of other
  initialisers say nothing of these pairs.
"""
