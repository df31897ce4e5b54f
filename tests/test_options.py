"""Options of all constructors: any option works or is refused with an error of ours, and nonsense is named."""

import inspect
import math
from functools import partial

import pytest
import torch
from data_helpers import make_scene
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError
from strategies import ANY, BOOL, COUNTS, RANGES, WORD, Seen, are_rotations, finite, many, options

from kornia_pnpnet import MLPInit, Normalize, PnPNet, PoseLoss, RobustWeightedLM, SetInit, SetLoss, create_solver
from kornia_pnpnet.data import (
    BoxPoints,
    CameraProblems,
    DrivePoints,
    FacadePoints,
    MixedPoints,
    MixedProblems,
    OutlierMix,
    RoomPoints,
    SceneProblems,
    SyntheticProblems,
    VaryingSize,
)
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.peers import KorniaRs, OpenCVPnP, OpenCVRansac, OpenCVUsac, PeerSolver, PoseLib, PyColmap
from kornia_pnpnet.propose.epnp import EPnP
from kornia_pnpnet.propose.minimal import SubsetSolver
from kornia_pnpnet.propose.p3p import P3P
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.propose.reppnp import REPPnP
from kornia_pnpnet.refine.kernels import BoundedParameter
from kornia_pnpnet.training import TrainSettings

PROBLEMS = SyntheticProblems(n=12, batch_size=3, seed=0).batch(0)


#: What is drawn for an option, by its type. Quotients by smaller numbers than 1e-9 may be infinite in float32.
KINDS = {
    "int": COUNTS,
    "float": ANY.filter(lambda x: not 0.0 < abs(x) < 1e-9),
    "str": WORD,
    "bool": BOOL,
    "None": st.none(),
}
KINDS |= dict.fromkeys(("Range", "tuple[float, float]", "Sequence[float]"), RANGES)
KINDS["Sequence[int]"] = st.lists(COUNTS, max_size=3)


def options_of(constructor):
    """At most two of the constructor's options; the others keep their defaults."""
    types = {x.name: x.annotation.split(" | ") for x in inspect.signature(constructor).parameters.values()}
    kinds = {name: [KINDS[x] for x in parts if x in KINDS] for name, parts in types.items() if name != "device"}
    return options(**{name: st.one_of(*drawn) for name, drawn in kinds.items() if drawn})


# --- what a constructor makes, and what the product must then do ------------------------------------------------------


def solves(part, values):
    """A solver with this part has finite results."""
    key = {RobustWeightedLM: "refine", Normalize: "normalize"}.get(type(part), "init")
    solver = part if isinstance(part, PeerSolver | PnPNet) else PnPNet(**{"init": EPnP(), key: part})
    n = values.get("n", 9)
    finite(*solver(PROBLEMS.world_points[:, :n], PROBLEMS.img_points[:, :n], PROBLEMS.intrinsics)[:4])


def costs(loss, values):
    """The loss of a result is finite."""
    result, guess = create_solver("pnpnet-set").with_starts(*PROBLEMS[:3])
    finite(loss(result, PROBLEMS, 1.0, guess) if isinstance(loss, SetLoss) else loss(result, PROBLEMS))


def is_sound(problems, values):
    """The drawn problems have finite points and proper rotations."""
    finite(problems._replace(img_sigma=None, world_sigma=None))
    are_rotations(problems.pose.rotation)
    assert problems.inliers.shape == problems.world_points.shape[:2]


def has_its_initial_value(parameter, values):
    values = {**BOUNDS, **values}
    value = parameter()
    assert value.shape == (values["size"],)
    slack = 1e-3 * (values["upper"] - values["lower"])
    torch.testing.assert_close(value, torch.full_like(value, values["initial"]), rtol=1e-3, atol=slack)


def synthetic(**values):
    return SyntheticProblems(**{"batch_size": 4, **values}).batch(0)


def from_scene(**values):
    return SceneProblems(make_scene(20, 12), **{"batch_size": 4, **values}).batch(0)


def with_points(prior, **values):
    return synthetic(points=prior(**values))


def with_mix(source, **values):
    return source(outliers=OutlierMix(**values))


def mixture(**values):
    mixed = partial(MixedProblems, [SyntheticProblems] * 2)
    return VaryingSize(mixed, **{"n": (5, 9), "batch_size": 6, **values}).batch(3)


def factors_are_sound(settings, values):
    """Learning rates and ramp stay in their bounds."""
    for update in range(13):
        assert 0 <= settings.lr_factor(update) < math.inf
        assert 0 <= settings.ramp_factor(update) <= 1


BOUNDS = {"initial": 3.0, "size": 2, "lower": 1.0, "upper": 50.0}
SOLVER_PARTS = (RobustWeightedLM, SetInit, EPnP, REPPnP, Normalize)
SOLVER_PARTS += (OpenCVPnP, OpenCVRansac, OpenCVUsac, KorniaRs, PoseLib, PyColmap)
POINTS = (BoxPoints, FacadePoints, RoomPoints, DrivePoints)

#: Whose options are drawn, what is made with them, and what the product must do.
CASES = [
    *((part, part, solves) for part in SOLVER_PARTS),
    (MLPInit, lambda n=9, **sizes: MLPInit(n, **sizes), solves),
    (RANSAC, partial(RANSAC, P3P()), solves),
    *((PnPNet, partial(create_solver, name), solves) for name in ("pnpnet-set", "pnpnet-n9", "p3p-ransac", "epnp-lm")),
    *((loss, loss, costs) for loss in (PoseLoss, SetLoss)),
    *((points, partial(with_points, points), is_sound) for points in POINTS),
    (MixedPoints, partial(with_points, partial(MixedPoints, [BoxPoints()] * 2)), is_sound),
    (SyntheticProblems, synthetic, is_sound),
    (SceneProblems, from_scene, is_sound),
    (OutlierMix, partial(with_mix, synthetic), is_sound),
    (OutlierMix, partial(with_mix, from_scene), is_sound),
    (VaryingSize, mixture, is_sound),
    (TrainSettings, lambda **values: TrainSettings(**{"updates": 12, **values}), factors_are_sound),
    (BoundedParameter, lambda **values: BoundedParameter(**{**BOUNDS, **values}), has_its_initial_value),
]


@pytest.mark.parametrize(("constructor", "make", "use"), CASES, ids=[case[0].__name__ for case in CASES])
def test_any_options_work_or_are_refused(constructor, make, use):
    made = Seen()
    try:
        make()
    except ImportError as error:
        pytest.skip(str(error))

    @many(60)
    @given(options_of(constructor))
    def run(values):
        product = made(lambda: make(**values))
        if product is not None:
            use(product, values)

    run()
    made.both(1)


#: Options that make no sense, by constructor.
REFUSED = [
    (RobustWeightedLM, {"kernel": "tukey", "update": "se3", "backward": "truncated", "step": 2.1, "damping": 0.0}),
    (RobustWeightedLM, {"robustness": 3.5, "m": -1, "by_residual": True}),
    (RobustWeightedLM, {"m": 2.5, "by_residual": -1}),
    (PnPNet, {"views": 0, "focal": "free", "focal_sigma": 0.1, "radial": 1, "effort": "adaptive"}),
    (PnPNet, {"views": 9, "gradient": "never"}),
    (partial(PnPNet, focal="unknown"), {"views": True, "focal_sigma": -1.0, "radial": 3}),
    (MLPInit, {"n": 2}),
    (MLPInit, {"n": "9"}),
    (SetInit, {"width": 0, "starts": 0, "layers": 1.5, "samples": 9}),
    (partial(SetInit, width=30), {"heads": 4}),
    (EPnP, {"iterations": 1, "algebraic_weight": -0.1}),
    (REPPnP, {"quantile": 1.1, "max_error": -1.0, "refine_iterations": 0}),
    (partial(RANSAC, P3P()), {"threshold": math.nan, "world_threshold": -1.0, "scorer": "best", "max_samples": 0}),
    (partial(RANSAC, P3P()), {"min_samples": 1.5, "confidence": 1.0, "final_steps": -1}),
    (partial(SubsetSolver, EPnP()), {"size": 2}),
    (OpenCVRansac, {"threshold": math.inf, "iterations": 0, "confidence": 1.0, "seed": -1, "refine": 1}),
    (OpenCVPnP, {"method": "NOPE"}),
    (OpenCVUsac, {"method": "USAC_FM_8PTS"}),
    (OpenCVUsac, {"method": "SOLVEPNP_EPNP"}),
    (KorniaRs, {"threshold": math.inf, "max_iterations": 0, "method": "P3P"}),
    (PoseLib, {"threshold": -1.0, "min_iterations": 0}),
    (PyColmap, {"loss_scale": 0.0, "max_iterations": 50}),
    (OutlierMix, {"max_ratio": 1.5, "count": -1, "min_count": -1, "mismatch_share": 2.0}),
    (OutlierMix, {"near_pixels": (3.0, 1.0), "structured_ratio": (0.0, 0.5), "crowd_share": 1.1, "max_crowds": 0}),
    (OutlierMix, {"structured_angle": -1.0, "mirrored_share": 1.5}),
    (FacadePoints, {"field_of_view": (15.0, 180.0), "window": (0.1, 1.1)}),
    (SyntheticProblems, {"degrees": 0.5, "sigma_spread": 4.0, "bunched_share": -0.1, "half_image": -1.0}),
    (SyntheticProblems, {"img_sigma": -1.0, "world_sigma": (0.0, 1.0)}),
    (SyntheticProblems, {"img_sigma": (2.0, 1.0), "world_sigma": (1.0, 2.0, 3.0)}),
    (CameraProblems, {"n": 0, "field_of_view": (90.0, 30.0), "outlier_share": 2.0, "cameras": 0}),
    (CameraProblems, {"field_of_view": (0.0, 30.0)}),
    (KnownInliersAndNoise, {"img_sigma": -1.0}),
    (partial(KnownInliersAndNoise, world_sigma=0.0), {"img_sigma": 0.0}),
    (partial(SceneProblems, make_scene(20)), {"n": 0, "batch_size": 0, "num_spares": 0}),
]


@pytest.mark.parametrize(("make", "wrong"), REFUSED)
def test_an_option_without_sense_is_named(make, wrong):
    for name, value in wrong.items():
        try:
            with pytest.raises(BaseError) as raised:
                make(**{name: value})
        except ImportError as error:
            pytest.skip(str(error))
        assert name in str(raised.value) or str(value) in str(raised.value)


class Wide(MLPInit):
    """A subclass with other arguments."""

    def __init__(self, kilopixels):
        super().__init__(9, img_scale=1000.0 * kilopixels)


def test_a_subclass_has_the_config_of_the_constructor_that_it_calls():
    assert Wide(2).config == MLPInit(9, img_scale=2000.0).config
    assert "img_scale=2000.0" in repr(Wide(2))
