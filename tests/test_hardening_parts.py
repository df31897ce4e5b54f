"""Whatever comes in, for the parts that solvers are made of and for all around them: metrics, data, readers, files."""

import contextlib
import importlib
import io
import json
import math
import re
from collections import Counter
from dataclasses import is_dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError
from test_data_colmap import make_scene, match_arrays, write_model
from test_docs import reference_modules
from test_hardening import INF, NAN, batches, damage, many, numbers, run_main

from kornia_pnpnet import (
    Guess,
    MLPInit,
    Normalize,
    PnPNet,
    Pose,
    PoseLoss,
    RobustWeightedLM,
    SetInit,
    SetLoss,
    create_solver,
    list_solvers,
    pose_covariance,
    pose_errors,
    success,
    success_rate,
)
from kornia_pnpnet.data import (
    BoxPoints,
    MixedProblems,
    ObjectPoints,
    OutlierMix,
    SceneProblems,
    SlabPoints,
    SyntheticProblems,
    VaryingSize,
    load_colmap,
    load_matches,
    load_scene,
)
from kornia_pnpnet.evaluation.figures import plot_pose, plot_sweep, plot_training
from kornia_pnpnet.evaluation.operations import complexity_results
from kornia_pnpnet.evaluation.results import save_results
from kornia_pnpnet.geometry import (
    additive_tangent_map,
    normal_equations,
    pixel_variance,
    project,
    retract,
    retract_additive,
    rotation_angle,
    transform,
)
from kornia_pnpnet.init import P3P, RANSAC, EPnP, REPPnP, SubsetSolver, p3p
from kornia_pnpnet.losses import pose_distances
from kornia_pnpnet.metrics import reliability
from kornia_pnpnet.peers import OpenCVPnP, OpenCVRansac, OpenCVUsac, PeerSolver, PoseLib, PyColmap
from kornia_pnpnet.refine.kernels import KERNELS
from kornia_pnpnet.refine.lm import BACKWARDS, BoundedParameter, explains, lm_step, solve_damped
from kornia_pnpnet.training.loop import TrainSettings
from kornia_pnpnet.types import Noise

ERRORS = BaseError, ValueError
#: Numbers for options: sound ones, and those that make no sense.
ANY = st.one_of(st.floats(-2.0, 200.0), st.sampled_from([0, 1, -1, 0.0, 1e-6, 1e6, INF, -INF, NAN]))
COUNTS = st.one_of(st.integers(-2, 12), st.sampled_from([0.5, NAN, True]))
RANGES = st.tuples(ANY, ANY)
BOOL = st.booleans()
WORD = st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), max_size=8) | st.sampled_from(
    [*KERNELS, *BACKWARDS, "additive", "msac", "AP3P", "EPNP", "USAC_FAST", "epnp-lm", "pnpnet-n9"]
)


@st.composite
def options(draw, **values):
    """None, one or two of these options; the others stay as they are."""
    names = draw(st.lists(st.sampled_from(sorted(values)), max_size=2, unique=True))
    return {name: draw(values[name]) for name in names}


class Seen:
    """Counts what could be made and what was refused."""

    def __init__(self, tally, what):
        self.tally, self.what, self.counts = tally, what, Counter()

    def __call__(self, make, errors=ERRORS):
        """What was made, or ``None``."""
        try:
            made = make()
        except errors:
            self.count("refused")
            return None
        self.count("works")
        return made

    def count(self, outcome):
        self.counts[outcome] += 1
        self.tally("options", f"{self.what}: {outcome}")

    def both(self, least=3):
        """Neither says all of it."""
        assert min(self.counts[x] for x in ("works", "refused")) >= least


@pytest.fixture
def seen(tally):
    return partial(Seen, tally)


def rotations(batch, seed, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    q, r = torch.linalg.qr(torch.randn(batch, 3, 3, generator=generator, dtype=torch.float64))
    q = q * r.diagonal(dim1=1, dim2=2).sign()[:, None]
    return (q * q.det()[:, None, None]).to(dtype)


@st.composite
def poses(draw, batch, dtype):
    """Of any size; finite."""
    shift = torch.randn(batch, 3, generator=torch.Generator().manual_seed(draw(st.integers(0, 99))))
    size = 10.0 ** draw(st.integers(-6, 6))
    return Pose(rotations(batch, draw(st.integers(0, 99)), dtype), size * shift.to(dtype))


def finite(*values):
    for value in values:
        if isinstance(value, torch.Tensor):
            assert value.dtype == torch.bool or value.isfinite().all()
        elif value is not None:
            finite(*value)


def are_rotations(matrices):
    finite(matrices)
    flat = matrices.detach().double().reshape(-1, 3, 3)
    torch.testing.assert_close(flat @ flat.mT, torch.eye(3).double().expand_as(flat), rtol=0, atol=1e-4)


def gradients_are_finite(values, tensors):
    total = sum(x.sum() for x in values if x.requires_grad)
    if tensors and isinstance(total, torch.Tensor):
        finite(*(x for x in torch.autograd.grad(total, tensors, allow_unused=True) if x is not None))


# -- metrics and losses -----------------------------------------------------------------------------------------------


@st.composite
def pose_pairs(draw):
    dtype, batch = draw(st.sampled_from([torch.float32, torch.float64])), draw(st.integers(0, 4))
    shapes = (batch, 3, 3), (batch, 3)
    pairs = [Pose(*(draw(numbers(dtype, shape)) for shape in shapes)) for _ in range(2)]
    sound = draw(st.booleans())
    if sound:
        pairs = [pose._replace(rotation=rotations(batch, i, dtype)) for i, pose in enumerate(pairs)]
    return pairs


@many(60)
@given(pose_pairs(), ANY, ANY)
def test_errors_of_any_poses(tally, pair, degrees, length):
    tally("parts", "`pose_errors`, `success`, `success_rate`, `rotation_angle`, `pose_distances`: of any poses")
    estimate, truth = pair
    errors = pose_errors(estimate, truth)
    batch = len(truth.translation)
    assert all(x.shape == (batch,) and x.dtype == truth.translation.dtype for x in errors)
    assert not (errors.rotation_error_deg < 0).any()
    assert not (errors.rotation_error_deg > 180.001).any()
    right = success(errors, degrees, length)
    assert right.dtype == torch.bool
    assert not right[errors.rotation_error_deg.isnan() | errors.translation_error.isnan()].any()
    assert rotation_angle(*(pose.rotation for pose in pair)).shape == (batch,)
    if batch:
        rate = success_rate(right)
        assert 0 <= rate.low <= rate.rate <= rate.high <= 1
    else:
        with pytest.raises(ValueError, match="at least one"):
            success_rate(right)
    tensors = [x.detach().clamp(-1e6, 1e6).nan_to_num(0.0).requires_grad_() for x in estimate]
    distances = pose_distances(Pose(*tensors), Pose(*(x.clamp(-1e6, 1e6).nan_to_num(0.0) for x in truth)))
    finite(distances)
    gradients_are_finite(distances, tensors)


@many(60)
@given(st.lists(st.sampled_from([(), (1,), (3,), (2, 3), (1, 3, 3), (2, 3, 3), (3, 3)]), min_size=4, max_size=4))
def test_poses_that_do_not_fit_are_an_error(tally, shapes):
    tally("parts", "`pose_errors`, `pose_distances` of shapes that do not fit: an error of the package's own types")
    assume(shapes not in ([(2, 3, 3), (2, 3)] * 2, [(3, 3), (3,)] * 2))
    first, second = (Pose(*(torch.zeros(shape) for shape in pair)) for pair in (shapes[:2], shapes[2:]))
    for function in (pose_errors, pose_distances):
        with pytest.raises(BaseError):
            function(first, second)


@many(60)
@given(st.sampled_from([(0,), (1,), (7,), (2, 3)]), st.sampled_from([(7,), (2, 3)]), st.integers(-1, 12), st.data())
def test_reliability_of_any_chances(tally, shape, other, ranges, data):
    tally("parts", "`reliability` of any chances: they are all counted, or an error")
    chances = data.draw(numbers(torch.float64, shape)).nan_to_num(0.5).clamp(0, 1)
    outcomes = torch.arange(math.prod(other)).view(other) % 2 == 0
    if shape == other and ranges >= 1:
        found = reliability(chances, outcomes, ranges)
        assert found.number.sum() == chances.numel()
        assert 0 <= found.expected_error <= 1
    else:
        with pytest.raises(ERRORS):
            reliability(chances, outcomes, ranges)


@many(40)
@given(batches(most=3))
def test_losses_of_any_result(tally, case):
    tally("parts", "`PoseLoss`, `SetLoss` of the result of any batch: finite with its gradient")
    inputs, mask, weights, kinds = case
    if not kinds:
        return
    truth = SyntheticProblems(n=inputs[0].shape[1], batch_size=len(kinds), dtype=inputs[0].dtype).batch(0)
    solver = SOLVER
    result, guess = solver.with_guess(*inputs, weights=weights, mask=mask)
    terms = [SetLoss()(result, truth, 1.0, guess), PoseLoss()(result, truth)]
    finite(terms)
    gradients_are_finite([x.total for x in terms], [x for x in inputs if x.requires_grad] or [SOLVER.refine.step.raw])


SOLVER = create_solver("pnpnet-set")


# -- what solvers are made of -----------------------------------------------------------------------------------------


@st.composite
def correspondences(draw, n=None, *, scaled=False):
    """Of any batch, as parts of a solver see them; ``scaled`` is for those that ask for a world about 0 of size 1."""
    inputs, mask, weights, _ = draw(batches(n))
    about = st.just(True) if scaled else BOOL
    normalize = Normalize(**draw(options(order=BOOL, center=about, scale=about)))
    tensors = [x for x in inputs if x.requires_grad]
    corr, frame = normalize(*inputs, weights=weights, mask=mask)
    finite(corr, frame)
    if draw(st.booleans()):
        corr = corr._replace(noise=Noise(torch.full_like(corr.weights, 0.5), torch.full_like(corr.weights, 0.01)))
    return corr, tensors


KINDS = st.sampled_from(list(KERNELS))


@many(60)
@given(correspondences(), st.data())
def test_the_calculus_takes_anything(tally, case, data):
    tally("parts", "`project`, `normal_equations`, `retract`, `lm_step` and the like, of any batch and pose: finite")
    corr, tensors = case
    batch, dtype = len(corr.world_points), corr.world_points.dtype
    pose = data.draw(poses(batch, dtype))
    finite(transform(pose, corr.world_points))
    projection = project(pose, corr)
    finite(projection)
    if corr.noise is not None:
        assert (pixel_variance(projection, corr.noise, corr.focal) > 0).all()
    equations = normal_equations(projection, corr.weights)
    damping = torch.tensor(10.0 ** data.draw(st.integers(-8, 2)), dtype=dtype)
    delta, solved = solve_damped(equations, damping)
    assert solved.shape == (batch,)
    finite([x[solved] for x in delta])
    explains(projection, corr, corr.weights)
    additive = data.draw(st.booleans())
    moved = lm_step(corr, pose, projection, corr.weights, torch.tensor(1.0, dtype=dtype), damping, additive=additive)
    finite(moved)
    are_rotations(moved.pose.rotation)
    gradients_are_finite([*moved.pose, *projection.residual], tensors)
    tangent = torch.randn(batch, 6, dtype=dtype)
    for move in (retract, retract_additive):
        are_rotations(move(pose, tangent).rotation)
    finite(additive_tangent_map(pose))


@many(80)
@given(
    correspondences(),
    st.integers(0, 4),
    options(
        kernel=KINDS,
        shared=st.booleans(),
        update=st.sampled_from(["retraction", "additive"]),
        reject_worse=st.booleans(),
        by_residual=st.integers(0, 3),
        backward=st.sampled_from(BACKWARDS),
    ),
    st.data(),
)
def test_refinements_take_anything(tally, case, m, chosen, data):
    tally("parts", "`RobustWeightedLM` with any options from any pose: finite with its gradient, a rotation")
    corr, tensors = case
    refine = RobustWeightedLM(m, **chosen).to(corr.world_points.dtype)
    pose = data.draw(poses(len(corr.world_points), corr.world_points.dtype))
    refined = refine(corr, Guess(pose, torch.ones_like(corr.weights)))
    finite(refined)
    are_rotations(refined.pose.rotation)
    gradients_are_finite(
        [*refined.pose, refined.cost], [*tensors, *(p for p in refine.parameters() if p.requires_grad)]
    )


INITIALISERS = {
    "EPnP": EPnP(),
    "REPPnP": REPPnP(),
    "MLPInit": MLPInit(9),
    "SetInit": SetInit(),
    "RANSAC of P3P": RANSAC(P3P(), max_samples=40),
    "RANSAC of SubsetSolver": RANSAC(SubsetSolver(EPnP(), size=5), max_samples=10, min_samples=5),
}


@pytest.mark.parametrize("name", INITIALISERS)
def test_initialisers_take_anything(name, tally):
    @many(30)
    @given(correspondences(9, scaled=name == "SetInit"))
    def run(case):
        tally("parts", f"`{name}` of any batch: finite with its gradient, a rotation")
        corr, tensors = case
        init = INITIALISERS[name].to(corr.world_points.dtype)
        guess = init(corr)
        finite(guess.pose, guess.weights, guess.others, guess.noise)
        are_rotations(guess.pose.rotation[(corr.weights > 0).any(-1)])
        assert (guess.weights >= 0).all()
        gradients_are_finite([*guess.pose, guess.weights], tensors)

    run()


@many(80)
@given(st.data(), st.integers(0, 4), st.sampled_from([torch.float32, torch.float64]))
def test_p3p_takes_anything(tally, data, batch, dtype):
    tally("parts", "`p3p` of any three points: finite with its gradient, rotations")
    points = [data.draw(numbers(dtype, (batch, 3, size))).requires_grad_() for size in (3, 2)]
    found = p3p(*points)
    assert found.valid.shape == found.pose.rotation.shape[:2]
    are_rotations(found.pose.rotation[found.valid])
    finite(found)
    gradients_are_finite(found.pose, points)


@many(60)
@given(st.data())
def test_covariances_of_any_numbers(tally, data):
    tally("parts", "`pose_covariance` of any numbers and shapes: an error of the package's own types, or no NaN")
    batch, count = data.draw(st.integers(0, 3)), data.draw(st.integers(0, 12))
    some = st.integers(0, 3)
    shapes = [(batch, 3, 3), (batch, 3), (batch, count, 3), (batch, count, 2), (3, 3)]
    if data.draw(st.booleans()):
        which = data.draw(st.integers(0, 4))
        shapes[which] = (*shapes[which][:-1], data.draw(some)) if data.draw(st.booleans()) else (data.draw(some),)
    rotation, translation, world, img, camera = (data.draw(numbers(torch.float64, shape)) for shape in shapes)
    sigma = data.draw(st.one_of(ANY, numbers(torch.float64, (), (batch,), (batch, count), (7,))))
    sound = [(batch, 3, 3), (batch, 3), (batch, count, 3), (batch, count, 2), (3, 3)] == shapes
    try:
        found = pose_covariance(Pose(rotation, translation), world, img, camera, img_sigma=sigma)
    except BaseError:
        assert not sound or (isinstance(sigma, torch.Tensor) and sigma.shape == (7,))
    else:
        assert sound
        assert found.shape == (batch, 6, 6)
        assert not found.isnan().any()


# -- options: what can be made works, the rest is refused -------------------------------------------------------------

SIGMAS = ANY | RANGES
MIX = options(
    max_ratio=ANY,
    count=COUNTS,
    min_count=COUNTS,
    mismatch_share=ANY,
    near_share=ANY,
    structured_share=ANY,
    min_inliers=COUNTS,
)
POINTS = {
    BoxPoints: options(half_width=ANY, z_near=ANY, depth=ANY),
    SlabPoints: options(window=RANGES, field_of_view=ANY, distance=RANGES, tilt=ANY, thickness=RANGES),
    ObjectPoints: options(distance=RANGES, field_of_view=ANY, thinnest=ANY, planar=ANY),
}
SOURCE = options(
    n=COUNTS,
    batch_size=COUNTS,
    seed=COUNTS,
    translation_box=ANY,
    translation_sigma=ANY,
    max_angle=ANY,
    focal=ANY,
    half_image=ANY,
    img_sigma=SIGMAS,
    world_sigma=SIGMAS,
    known_noise=ANY,
)


def sound(problems):
    """What every batch of problems keeps."""
    finite(*problems[:5])
    are_rotations(problems.pose.rotation)
    assert problems.inliers.shape == problems.world_points.shape[:2]


def draw_sound_problems(made, chosen, make):
    """Every source that can be made of what is chosen draws sound problems."""

    @many(80)
    @given(chosen)
    def run(values):
        problems = made(lambda: make(values))
        if problems is not None:
            sound(problems)

    run()
    made.both()


@pytest.mark.parametrize("prior", POINTS)
def test_problems_of_any_options(prior, seen):
    def make(chosen):
        source, points = chosen
        return SyntheticProblems(**{"batch_size": 4, **source}, points=prior(**points)).batch(0)

    made = seen(f"`SyntheticProblems` and `{prior.__name__}` with any options")
    draw_sound_problems(made, st.tuples(SOURCE, POINTS[prior]), make)


@pytest.mark.parametrize(
    ("name", "source"),
    {
        "SyntheticProblems": partial(SyntheticProblems, batch_size=4),
        "SceneProblems": partial(SceneProblems, make_scene(20, 12), batch_size=4),
    }.items(),
)
def test_wrong_pairs_of_any_options(name, source, seen):
    made = seen(f"`OutlierMix` with any options, in `{name}`")
    draw_sound_problems(made, MIX, lambda mix: source(outliers=OutlierMix(**mix)).batch(0))


def test_scenes_of_any_options(seen):
    chosen = options(
        n=COUNTS,
        batch_size=COUNTS,
        seed=COUNTS,
        num_spares=COUNTS,
        translation_box=ANY,
        max_angle=ANY,
        recentre=BOOL,
    )
    made = seen("`SceneProblems` with any options")
    draw_sound_problems(
        made, chosen, lambda values: SceneProblems(make_scene(20, 12), **{"batch_size": 4, **values}).batch(0)
    )


def test_mixtures_of_any_options(seen):
    def make(values):
        given_options, count = values
        sizes = {key: value for key, value in given_options.items() if key != "shares"}
        mixed = partial(MixedProblems, [SyntheticProblems] * count, shares=given_options.get("shares"))
        return VaryingSize(mixed, **{"n": (5, 9), "batch_size": 6, **sizes}).batch(3)

    chosen = options(n=st.lists(COUNTS, max_size=3), batch_size=COUNTS, seed=COUNTS, shares=st.lists(ANY, max_size=3))
    made = seen("`MixedProblems`, `VaryingSize` with any options")
    draw_sound_problems(made, st.tuples(chosen, st.integers(0, 3) | st.just(2)), make)


SAMPLING = {"threshold": ANY, "iterations": COUNTS, "confidence": ANY, "seed": COUNTS}
MAKERS = {
    "RobustWeightedLM": (
        RobustWeightedLM,
        options(
            m=COUNTS,
            kernel=WORD,
            step=ANY,
            damping=ANY,
            robustness=ANY,
            shared=BOOL,
            update=WORD,
            by_residual=COUNTS,
            backward=WORD,
            last=COUNTS,
        ),
    ),
    "MLPInit": (lambda n=9, **sizes: MLPInit(n, **sizes), options(n=COUNTS, world_scale=ANY, img_scale=ANY)),
    "SetInit": (SetInit, options(width=COUNTS, layers=COUNTS, heads=COUNTS, hidden=COUNTS, starts=COUNTS)),
    "EPnP": (EPnP, options(iterations=COUNTS, algebraic_weight=ANY)),
    "REPPnP": (REPPnP, options(max_error=ANY, quantile=ANY, null_iterations=COUNTS, rigid_iterations=COUNTS)),
    "RANSAC": (
        partial(RANSAC, P3P()),
        options(threshold=ANY, world_threshold=ANY, scorer=WORD, max_samples=COUNTS, confidence=ANY, seed=COUNTS),
    ),
    "Normalize": (Normalize, options(f_const=ANY)),
    "OpenCVPnP": (OpenCVPnP, options(method=WORD)),
    "OpenCVRansac": (OpenCVRansac, options(**SAMPLING, method=WORD, refine=BOOL)),
    "OpenCVUsac": (OpenCVUsac, options(**SAMPLING, method=WORD)),
    "PoseLib": (PoseLib, options(threshold=ANY, min_iterations=COUNTS, max_iterations=COUNTS, confidence=ANY)),
    "PyColmap": (PyColmap, options(threshold=ANY, loss_scale=ANY, min_iterations=COUNTS, max_iterations=COUNTS)),
}


@pytest.mark.parametrize("name", MAKERS)
def test_parts_of_any_options(name, seen):
    make, chosen = MAKERS[name]
    problems = SyntheticProblems(n=12, batch_size=3, seed=0).batch(0)
    made = seen(f"`{name}` with any options")
    with contextlib.suppress(ImportError):
        make()

    @many(60)
    @given(chosen)
    def run(values):
        part = made(lambda: make(**values))
        if part is None:
            return
        key = {"RobustWeightedLM": "refine", "Normalize": "normalize"}.get(name, "init")
        solver = part if isinstance(part, PeerSolver) else PnPNet(**{"init": EPnP(), key: part})
        n = values.get("n", 9)
        finite(*solver(problems.world_points[:, :n], problems.img_points[:, :n], problems.intrinsics)[:4])

    run()
    made.both()


def test_bounded_parameters_of_any_bounds(seen):
    made = seen("`BoundedParameter` with any numbers")

    @many(80)
    @given(options(initial=ANY, size=COUNTS, lower=ANY, upper=ANY, logarithmic=BOOL))
    def run(chosen):
        values = {"initial": 3.0, "size": 2, "lower": 1.0, "upper": 50.0, **chosen}
        parameter = made(lambda: BoundedParameter(**values))
        if parameter is not None:
            value = parameter()
            assert value.shape == (values["size"],)
            wanted = torch.full_like(value, values["initial"])
            slack = 1e-3 * (values["upper"] - values["lower"])
            torch.testing.assert_close(value, wanted, rtol=1e-3, atol=slack)

    run()
    made.both()


def test_losses_of_any_options(seen):
    made = seen("`PoseLoss`, `SetLoss` with any options")
    problems = SyntheticProblems(n=9, batch_size=3, seed=0).batch(0)
    result, guess = SOLVER.with_guess(*problems[:3])

    @many(80)
    @given(
        BOOL,
        options(refined=ANY, saturation=ANY),
        options(rotation=ANY, translation=ANY, init_translation=ANY),
        options(starts=COUNTS, every=ANY, weights=ANY, noise=ANY, rotation_unit=ANY, translation_unit=ANY),
    )
    def run(of_set, both, first, second):
        loss = made(lambda: SetLoss(**both, **second) if of_set else PoseLoss(**both, **first))
        if loss is not None:
            finite(loss(result, problems, 1.0, guess) if of_set else loss(result, problems))

    run()
    made.both()


def test_solvers_of_any_name_and_options(seen):
    made = seen("`create_solver` of any name with any options")
    chosen = options(m=COUNTS, threshold=ANY, iterations=COUNTS, seed=COUNTS, confidence=ANY, views=COUNTS, unknown=ANY)

    @many(150)
    @given(st.sampled_from(list_solvers()) | WORD, chosen)
    def run(name, values):
        solver = made(lambda: create_solver(name, **values), (*ERRORS, ImportError, FileNotFoundError))
        if solver is not None:
            number = re.search(r"-n(\d+)$", name)
            problems = SyntheticProblems(n=int(number[1]) if number else 9, batch_size=2, seed=0).batch(0)
            finite(*solver(*problems[:3])[:4])

    run()
    made.both()


def test_trainings_of_any_settings(seen):
    made = seen("`TrainSettings` of any numbers")

    @many(120)
    @given(
        options(
            updates=COUNTS,
            lr=ANY,
            lr_refine=ANY,
            warmup=COUNTS,
            final_lr=ANY,
            clip=ANY,
            ramp=RANGES,
            max_skipped=COUNTS,
            log_every=COUNTS,
            validate_every=COUNTS,
            checkpoint_every=COUNTS,
        ),
        st.integers(0, 12),
    )
    def run(chosen, update):
        settings = made(lambda: TrainSettings(**{"updates": 12, **chosen}))
        if settings is not None:
            assert 0 <= settings.lr_factor(update) < INF
            assert 0 <= settings.ramp_factor(update) <= 1
            assert 0 <= settings.lr < INF

    run()
    made.both()


# -- files ------------------------------------------------------------------------------------------------------------


def names_the_file(error, path):
    assert str(path) in str(error)


def test_damaged_scenes_are_an_error_of_ours(tally, tmp_path):
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    model = tmp_path / "model"
    write_model(model, "PINHOLE")
    sound_files = {path.name: path.read_bytes() for path in model.iterdir()}

    @many(100)
    @given(st.sampled_from(sorted(sound_files)), st.data())
    def run(name, data):
        tally("files", "`load_colmap`, `load_scene` of a damaged text model: a scene of finite numbers, or one error")
        (model / name).write_bytes(data.draw(damage(sound_files[name])))
        try:
            scene = data.draw(st.sampled_from([load_colmap, load_scene]))(model)
        except (ValueError, OSError) as error:
            names_the_file(error, model)
        else:
            finite(*((view.world_points, view.img_points, view.rotation, view.translation) for view in scene.views))
        finally:
            (model / name).write_bytes(sound_files[name])

    run()


def test_damaged_matches_are_an_error_of_ours(tally, tmp_path):
    file = io.BytesIO()
    np.savez(file, **match_arrays(30, 20))
    path = tmp_path / "matches.npz"

    @many(150)
    @given(damage(file.getvalue()))
    def run(content):
        tally("files", "`load_matches` of a damaged file: a scene of finite numbers, or one error")
        path.write_bytes(content)
        try:
            scene = load_matches(path)
        except (ValueError, OSError) as error:
            names_the_file(error, path)
        else:
            finite(*((view.world_points, view.img_points, view.rotation, view.translation) for view in scene.views))

    run()


@st.composite
def spoiled(draw, content, places):
    """Results of which some values were lost or replaced."""
    content = json.loads(json.dumps(content))
    for _ in range(draw(st.integers(1, 3))):
        *path, last = draw(st.sampled_from(places))
        inner = content
        try:
            for key in path:
                inner = inner[key]
            if draw(st.booleans()):
                del inner[last]
            else:
                inner[last] = draw(st.sampled_from([None, "", "x", -1, 0, 1e300, [], {}, [None], True, {"a": 1}]))
        except (KeyError, IndexError, TypeError):
            continue
    return content


def places_in(content, path=()):
    """All keys and indices of nested lists and dictionaries; of long lists the first two."""
    items = (
        content.items() if isinstance(content, dict) else enumerate(content[:2]) if isinstance(content, list) else ()
    )
    for key, value in items:
        yield (*path, key)
        yield from places_in(value, (*path, key))


def test_spoiled_results_are_a_line_and_no_traceback(tally, tmp_path):
    made, costs, path = (tmp_path / f"{name}.json" for name in ("results", "costs", "spoiled"))
    arguments = "evaluate", "--solver", "epnp", "--problems", "20", "--n", "9,12", "--outliers", "none,3", "--out"
    assert run_main(*arguments, made)[0] == 0
    save_results(complexity_results(["epnp"], range(6, 9)), costs)
    both = [json.loads(file.read_text()) for file in (made, costs)]
    both = {kind: (content, list(places_in(content))) for kind, content in zip(("results", "costs"), both, strict=True)}
    codes = Counter()

    @many(60)
    @given(st.sampled_from(sorted(both)), BOOL, st.data())
    def run(kind, plot, data):
        path.write_text(json.dumps(data.draw(spoiled(*both[kind]))))
        more = ("--plot", tmp_path / "plot") if plot else ()
        figures = "figures", path, "--out", tmp_path / "figures"
        code, _, err = run_main(*((*arguments, path, *more) if kind == "results" and plot else figures))
        tally("files", f"`pnpnet figures`, `pnpnet evaluate` of spoiled {kind}: pictures, or one line of error")
        codes[code] += 1
        assert code in (0, 2)
        if code == 2:
            assert err.startswith("pnpnet: ")
            assert err.count("\n") == 1

    run()
    assert min(codes[0], codes[2]) >= 5


def test_pictures_of_any_numbers(tally, tmp_path):
    path = tmp_path / "picture.png"

    @many(25)
    @given(st.integers(0, 5), st.data(), st.none() | st.tuples(ANY, ANY))
    def run(count, data, size):
        tally("files", "`plot_pose` of any numbers: a picture or an error")
        shapes = (count, 2), data.draw(st.sampled_from([(count, 2), (count, 2), (count, 3), (2,)]))
        points = [data.draw(numbers(torch.float64, shape)) for shape in shapes]
        path.unlink(missing_ok=True)
        try:
            plot_pose(path, *points, torch.arange(count) % 2 == 0, size)
        except ERRORS:
            assert not path.exists()
        else:
            assert path.stat().st_size > 1000

    run()


CURVES = {
    plot_training: "update,total,init_rotation,init_translation,refined_rotation,refined_translation,val/a/success\n"
    "0,3.5,1,2,3,4,\n100,2.5,1,2,3,4,0.5\n200,1.5,1,2,3,4,0.75\n",
    partial(plot_sweep, against="n"): "model.n,model.m,data.outliers.max_ratio,us_per_problem,uniform/rate,uniform/low,"
    "uniform/high\n6,5,0.33,20.5,0.5,0.4,0.6\n9,5,0.33,20.5,0.6,0.5,0.7\n9,8,0,20.5,0.8,0.7,0.9\n",
}


@pytest.mark.filterwarnings("ignore::UserWarning")  # about names of curves
@pytest.mark.parametrize("plot", CURVES, ids=["plot_training", "plot_sweep"])
def test_damaged_curves_are_an_error_of_ours(plot, tally, tmp_path, request):
    path = tmp_path / "curves.csv"

    @many(25)
    @given(damage(CURVES[plot].encode()))
    def run(content):
        tally("files", f"`{request.node.callspec.id}` of a damaged CSV file: a picture, or one error")
        path.write_bytes(content)
        try:
            plot(tmp_path / "picture.png", path)
        except ValueError as error:
            names_the_file(error, path)

    run()


#: Public names that none of these files says, and where they are called.
ELSEWHERE = {
    "here, by `pnpnet evaluate` and `pnpnet figures`": """
        draw_problems evaluate format_table load_results row_errors paper_figures plot_errors plot_operations
        plot_success plot_synthetic""",
    "here, by solvers": "Normalize Pose PeerSolver change_tangent find_weights move problems_last shipped_weights",
    "here, by `pnpnet solve --batch`": "solve_shards",
    "in trainings that are killed (test_interruptions.py)": "fit validate describe_shares",
    "nowhere: what others have to be like": "PointPrior",
}


def test_every_public_name_is_accounted_for():
    files = "test_hardening.py", "test_hardening_parts.py", "test_hardening_tools.py", "test_interruptions.py"
    source = "\n".join(Path(__file__).with_name(name).read_text() for name in files)
    source = re.sub(r"ELSEWHERE = \{.*?\n\}", "", source, flags=re.DOTALL)
    elsewhere = set(" ".join(ELSEWHERE.values()).split())
    said = set(re.findall(r"\w+", source))
    missing = set()
    for module in reference_modules():
        for name in importlib.import_module(module).__all__:
            value = getattr(importlib.import_module(module), name)
            holds = isinstance(value, type) and (issubclass(value, tuple) or is_dataclass(value))
            if callable(value) and not holds and name not in said | elsewhere:
                missing.add(name)
    assert not missing
