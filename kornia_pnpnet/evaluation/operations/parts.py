"""How many operations one call of each part of a solver takes, as formulas in its sizes."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

from kornia_pnpnet.evaluation.operations.operations import Operations, cholesky, matmul, smallest, solve, sort
from kornia_pnpnet.init.ransac.search import FIRST_PAIRS, KEPT_ONE_IN

__all__ = ["PARTS"]


def _mlp(n: int) -> Operations:
    """One product and one sum for each weight of the network of the paper's figure 2, a comparison for each ReLU."""
    shared, branch = [5 * n, 20 * n, 5 * n, 3 * n], [3 * n] + 5 * [2 * n]
    hidden = [*pairwise(shared), *pairwise(branch), *pairwise(branch)]
    weights = sum(size_in * size_out for size_in, size_out in hidden) + 2 * n * (4 + 3)
    units = sum(size_out for _, size_out in hidden)
    layers = Operations(add=weights, multiply=weights, compare=units)
    scale_inputs = Operations(divide=5 * n)
    rotation = Operations(add=15, multiply=26, divide=2, sqrt=2, log=2, compare=1)  # by way of the unit quaternion
    return scale_inputs + layers + rotation


def _set_network(n: int, width: int, layers: int, hidden: int, starts: int) -> Operations:
    """The layers of a set network: nearly all of it is a product and a sum for each weight that a pair meets."""
    features, outputs = 14, 1 + 2 * starts
    norm = n * Operations(add=4 * width - 1, multiply=3 * width, divide=3, sqrt=1)

    def pooled(scores: int) -> Operations:
        """The mean of the pairs by their scores, a softmax over the pairs."""
        softmax = scores * Operations(add=3 * n - 1, divide=n, exp=n, compare=n - 1)
        return softmax + Operations(add=(n - 1) * width, multiply=n * width)

    look = matmul(n, width, 2 * width) + pooled(width) + Operations(add=width)
    inner = matmul(n, width, hidden) + matmul(1, width, hidden) + Operations(add=(n + 1) * hidden, compare=n * hidden)
    outer = matmul(n, hidden, width) + Operations(add=2 * n * width)
    first = matmul(n, features, width) + Operations(add=n * width, compare=n, logic=n)
    of_pairs = matmul(n, width, outputs) + Operations(add=n * outputs)
    of_problem = pooled(1) + matmul(1, width, starts + 2) + Operations(add=starts + 2)
    return first + layers * (norm + look + inner + outer) + norm + of_pairs + of_problem


def _set_samples(n: int, judges: int, samples: int, groups: int) -> Operations:
    """The likeliest pairs, and how much of them each of the samples' four poses has on its side."""
    poses = 4 * samples
    votes = Operations(add=n, multiply=n, compare=n, logic=2 * n) + smallest(n, judges) + sort(judges)
    valid = Operations(divide=6 * samples, compare=3 * samples, logic=2 * samples + poses)
    # Which samples a problem has by the number of its pairs.
    drawn = groups * Operations(add=n - 1, compare=1) + Operations(logic=poses) if groups > 1 else Operations()
    scores = poses * Operations(add=3 * judges - 1, multiply=3 * judges, divide=2 * judges, logic=judges)
    return votes + valid + drawn + scores + Operations(compare=poses, logic=poses + 12)


def _inverse(n: int) -> Operations:
    """REPPnP's inverse of a matrix with a ridge."""
    return solve(n, n) + Operations(add=n * n)


def _rank(n: int, poses: int, kept: int) -> Operations:
    """The best poses of a round: of 32 pairs or more, 16 are scored first and four times as many for the best quarter.

    A pose and a pair take 9 sums and 12 products to project; residual, threshold and loss are the rest.
    """
    total, pairs = Operations(), FIRST_PAIRS
    while 2 * pairs <= n:
        best = max(poses // KEPT_ONE_IN, kept)
        total += _scores(pairs, poses) + smallest(poses, best) + Operations(multiply=pairs, divide=pairs)
        poses, pairs = best, KEPT_ONE_IN * pairs
    return total + _scores(n, poses) + smallest(poses, kept) + sort(kept)


def _scores(n: int, poses: int) -> Operations:
    return poses * Operations(add=15 * n - 1, multiply=19 * n, divide=n, compare=3 * n, logic=2)


def _best_of_samples(samples: int, size: int, slots: int, kept: int, drawn: bool) -> Operations:
    """Gathering samples of some size, with some poses each, and drawing them unless all subsets are enumerated."""
    gather = Operations(
        add=samples * (size + slots) - 1,
        multiply=4 * slots * samples + 1,
        divide=4 * kept,
        compare=samples * size,
        logic=samples * (size - 1 + slots),
    )
    earlier = size * (size - 1) // 2
    draw = samples * Operations(add=earlier, multiply=size, compare=size + 3 * earlier)
    return gather + draw + Operations(add=2 * size, compare=size) if drawn else gather


#: Operations of one call of a part as a function of its sizes, first of all the number of pairs n. Data that are only
#: moved cost nothing; what is computed once for the whole batch is not counted.
PARTS: dict[str, Callable[..., Operations]] = {
    # Checks of all inputs; a change of pixels; mean, covariance and scale of the world; two sorts.
    "normalize.Normalize.forward": lambda n, order: (
        Operations(add=22 * n + 2, multiply=24 * n + 28, divide=8, sqrt=5, compare=25 * n + 42, logic=13 * n + 19)
        + order * (Operations(logic=2 * n) + 2 * sort(n))
    ),
    # Two sorts of each mirrored problem.
    "normalize.Normalize.views": lambda n, views, order: (
        order * (views - 1) * (Operations(compare=n, logic=2 * n) + 2 * sort(n))
    ),
    "normalize.Normalize.undo_views": lambda views: Operations(),
    "normalize.Normalize.apply_to_pose": lambda: matmul(3, 3, 1) + Operations(add=3, multiply=3),
    "normalize.Normalize.undo": lambda: matmul(3, 3, 1) + Operations(add=3, divide=3),
    # Checks of everything that is returned, of the initialiser's word, and of a pose that was given.
    "model.PnPNet._result": lambda n, init_ok, noise: Operations(
        add=n + 5, multiply=2, compare=8, logic=n + 28 + init_ok + noise
    ),
    "model.PnPNet._given": lambda: Operations(compare=36, logic=13),
    "model.PnPNet._guess": lambda n, noise: Operations(compare=noise * n),
    # Whether so many inliers could be chance.
    "model._is_no_chance": lambda n: Operations(
        add=6 * n + 8, multiply=13 * n + 1, divide=5 * n + 1, sqrt=n, log=5, compare=14 * n + 5, logic=10 * n
    ),
    "mlp.MLPInit.forward": _mlp,
    # Rays, the frames of camera and world, the affine camera by cofactors.
    "set._View.__init__": lambda n: (
        n * Operations(add=47, multiply=56, divide=8, sqrt=1, compare=30, logic=2)
        + Operations(add=63, multiply=110, divide=17, sqrt=5, log=3, compare=6, logic=1)
    ),
    "set.SetInit._run": _set_network,
    # Likelihoods; for each hypothesis where the points are and how much they count, its alignment, and turning it back.
    "set.SetInit.forward": lambda n, starts: (
        Operations(add=n, divide=n, exp=n)
        + starts * Operations(add=27 * n + 43, multiply=32 * n + 81, divide=2 * n + 1, exp=2 * n + 1, log=n)
        + starts * Operations(compare=2 * n + 4, logic=2)
    ),
    "set.SetInit._noise": lambda n: Operations(add=2, multiply=2 * n + 3, exp=2 * n, log=2, logic=2 * n),
    "set.SetInit._sampled": _set_samples,
    # R x + t (9 products, 9 sums), in front (3, 8), x/z and y/z (3), times the focal length minus the pixel (2, 4).
    "geometry.project": lambda n: n * Operations(add=14, multiply=24, divide=1, compare=3, logic=1),
    # What a unit of the world is in pixels, for each projection; the square of the pixel's noise once for each pair.
    "geometry.pixel_variance": lambda projections, n: Operations(add=3 * projections, multiply=7 * projections + 2 * n),
    # Of the 21 entries of the matrix and the 6 of the gradient what is not known beforehand.
    "geometry.normal_equations": lambda n: Operations(add=41 * n - 25, multiply=44 * n),
    # Cayley's map: two cross products with the rows of the rotation.
    "geometry.move": lambda: Operations(add=42, multiply=52, divide=1),
    # Prior weights, relative to the largest, with and without the guess's; those of an iteration by the rows of the
    # Jacobian.
    "lm.RobustWeightedLM.begin": lambda n, by_residual: (
        Operations(multiply=n) + (1 + by_residual) * Operations(divide=n, compare=n, logic=1)
    ),
    "lm.RobustWeightedLM.finish": lambda n, noise, by_residual: (
        Operations(add=n, multiply=3 * n, logic=n + 1)
        + noise * Operations(add=n - 1, divide=n, compare=n + 1, logic=n)
        + (noise and by_residual) * Operations(divide=n, logic=n)
    ),
    "lm.RobustWeightedLM.choose": lambda starts: Operations(add=1, multiply=1, compare=starts - 1),
    # Weights by the residuals, in standard deviations where the noise is known.
    "lm._iterate": lambda n, noise, corrected: (
        n * Operations(add=1, multiply=3 + 2 * noise, divide=noise)
        + corrected * Operations(multiply=1, divide=n, compare=1, logic=n + 1)
    ),
    "lm._variance_factor": lambda n: Operations(add=2 * n + 1, multiply=4 * n + 3, divide=1, log=1, compare=4, logic=3),
    "lm._relative": lambda n: Operations(multiply=2 * n, divide=n, compare=n, logic=1),
    "lm.RobustWeightedLM._cost": lambda n, noise: Operations(
        add=3 * n - 2, multiply=3 * n, divide=1 + noise * n, compare=2 * n + 1, logic=n
    ),
    # The kernel 1 / |r|^alpha with any alpha: a power; its loss with a series near alpha = 2.
    "robust._power_weight": lambda n: n * Operations(add=1, multiply=1, exp=1, log=1),
    "robust._geman_mcclure_weight": lambda n: n * Operations(add=1, multiply=1, divide=2),
    "robust._geman_mcclure_loss": lambda n: n * Operations(add=1, divide=2),
    "robust._power_loss": lambda n: n * Operations(add=5, multiply=7, divide=3, exp=1, log=1, compare=3, logic=3),
    # The step times the solution, where there is one.
    "lm.lm_step": lambda: Operations(multiply=6, logic=1),
    # LDL' of 6 x 6, entry by entry.
    "lm.solve_damped": lambda: Operations(add=71, multiply=98, divide=6, compare=6, logic=11),
    # One quantile by sorting.
    "lm.explains": lambda n: (
        Operations(add=11 * n - 7, multiply=6 * n + 1, divide=n, compare=3 * n + 4, logic=3 * n + 1) + sort(n)
    ),
    # Gram-Schmidt on the coordinates of the points.
    "control_points.control_points": lambda n: Operations(
        add=34 * n - 22, multiply=45 * n + 3, divide=n + 3, sqrt=3, compare=13, logic=11
    ),
    # Newton's iteration on the quaternion.
    "small.nearest_rotation": lambda: Operations(add=198, multiply=281, divide=27, sqrt=4, log=2, compare=31, logic=20),
    # The last alignment, and which points are in front of the camera.
    "epnp.EPnP.forward": lambda n: Operations(
        add=5 * n + 83, multiply=3 * n + 117, divide=2 * n + 10, compare=2 * n + 15, logic=n + 11
    ),
    # Moments of the pixels with the 4 coordinates, and of what they leave.
    "depths.depth_system": lambda n: Operations(add=72 * n - 10, multiply=81 * n + 27, divide=9, sqrt=1, logic=1),
    # Eigenvectors of 3 x 3, distances of the control points, and the linear systems of the four cases.
    "depths.four_cases": lambda: Operations(add=741, multiply=1150, divide=25, sqrt=20, compare=49, logic=24),
    # Normal equations of 4 depths in 6 distances, and their solution.
    "depths.minimize": lambda cases, iterations: (
        Operations(multiply=16) + cases * iterations * Operations(add=282, multiply=370, divide=4, compare=4)
    ),
    # A rotation and the reprojection error for each of the four cases.
    "epnp.best_case": lambda n: Operations(
        add=52 * n + 242, multiply=56 * n + 383, divide=4 * n + 10, sqrt=10, compare=8 * n + 3, logic=4 * n
    ),
    # The pairs in their own frame, features of the null space, and whether the last equations have full rank.
    "reppnp.REPPnP.forward": lambda n, refine_iterations: (
        Operations(add=10 * n + 13, multiply=16 * n + 33, divide=6 * n, sqrt=1, compare=n + 10)
        + Operations(logic=42 * refine_iterations + 11)
        + cholesky(6)
    ),
    # Sums over the pairs, then 12 unknowns in blocks of 4: inverses of 4 x 4 and 3 x 3.
    "reppnp._null_vector": lambda n: (
        matmul(4, n, 16)
        + _inverse(4)
        + matmul(4, 4, 8)
        + matmul(4, 8, 4)
        + _inverse(3)
        + matmul(3, 3, 1)
        + 2 * matmul(4, 4, 1)
        + Operations(add=16, multiply=4 * n, logic=n)
    ),
    # Leverage of each pair: the inverses times its rows. Then the 2 x 2 systems of leaving it out.
    "reppnp._null_error": lambda n: (
        matmul(12, 4, n)
        + matmul(4, 3, 2 * n)
        + Operations(add=26 * n + 8, multiply=25 * n + 9, divide=2 * n, compare=n + 1, logic=n)
    ),
    "reppnp._rigid_error": lambda n: (
        _inverse(6) + matmul(6, 6, 2 * n) + Operations(add=20 * n, multiply=30 * n, divide=n, compare=n, logic=n)
    ),
    "reppnp.REPPnP._keep": lambda n: Operations(add=n, multiply=1, compare=n + 4, logic=2 * n) + sort(n),
    # Points to control points, then Procrustes.
    "reppnp._aligned": lambda n: Operations(add=34 * n + 8, multiply=36 * n + 26, divide=n + 4, compare=3, logic=n + 3),
    "reppnp._linearize": lambda n: n * Operations(add=13, multiply=15),
    "reppnp._normal_matrix": lambda n: matmul(6, 2 * n, 7) + Operations(multiply=12 * n, logic=n),
    "reppnp._step": lambda: _inverse(6) + matmul(6, 6, 1),
    # A root of a cubic, four candidates, their Newton steps and their rotations: nothing depends on n.
    "p3p.p3p": lambda: Operations(add=634, multiply=748, divide=36, sqrt=21, exp=1, log=1, compare=135, logic=18),
    "p3p.P3P.hypotheses": lambda: Operations(divide=6),
    # Whether the 12 numbers of a pose are finite.
    "ransac.SubsetSolver.hypotheses": lambda init_ok: Operations(multiply=12, compare=48, logic=23 + init_ok),
    "search.Search._best_of_samples": _best_of_samples,
    "search.Search._rank": _rank,
    # Inliers of a pose, and its score after the step on them.
    "search.Search._descend": lambda n: Operations(
        add=17 * n - 1, multiply=24 * n + 9, divide=3 * n, compare=5 * n + 5, logic=3 * n + 14
    ),
    "search.Search._improve": lambda poses: Operations(compare=poses - 1),
    # Two steps to the nearest rotation; then each round: how many samples are needed; and inliers of a better pose.
    "search.Search.run": lambda n, size, rounds, better: (
        2 * (2 * matmul(3, 3, 3) + Operations(add=9, multiply=18))
        + Operations(compare=1)
        + rounds * Operations(add=2 * size + 1, multiply=size + 1, divide=size + 1, log=1, compare=2 * size + 4)
        + better * Operations(add=3 * n - 1, multiply=4 * n + 2, divide=2 * n, compare=3 * n, logic=3 * n)
    ),
    # Centring, thresholds, the inliers twice, and whether so many could be chance.
    "ransac.RANSAC.forward": lambda n: Operations(
        add=20 * n + 12, multiply=16 * n + 21, divide=11 * n + 2, sqrt=n, log=5, compare=19 * n + 13, logic=15 * n + 4
    ),
}
