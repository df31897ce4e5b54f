"""Options of all constructors: any option works or is refused with an error of ours, and nonsense is named."""

from __future__ import annotations

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
    DrivePoints,
    FacadePoints,
    MixedPoints,
    MixedProblems,
    ObjectPoints,
    OutlierMix,
    RoomPoints,
    SceneProblems,
    SlabPoints,
    SyntheticProblems,
    VaryingSize,
)
from kornia_pnpnet.peers import KorniaRs, OpenCVPnP, OpenCVRansac, OpenCVUsac, PeerSolver, PoseLib, PyColmap
from kornia_pnpnet.propose.epnp import EPnP
from kornia_pnpnet.propose.minimal import SubsetSolver
from kornia_pnpnet.propose.p3p import P3P
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.propose.reppnp import REPPnP
from kornia_pnpnet.refine.parameters import BoundedParameter
from kornia_pnpnet.training import TrainSettings

PROBLEMS = SyntheticProblems(n=12, batch_size=3, seed=0).batch(0)


def chosen(counts="", numbers="", words="", flags="", ranges="", **others):
    """At most two of the named options; the others keep their defaults."""
    kinds = ((counts, COUNTS), (numbers, ANY), (words, WORD), (flags, BOOL), (ranges, RANGES))
    return options(**{name: kind for names, kind in kinds for name in names.split()}, **others)


# --- what a constructor makes, and what the product must then do ------------------------------------------------------


def solves(part, values):
    """A solver with this part has finite results."""
    key = {RobustWeightedLM: "refine", Normalize: "normalize"}.get(type(part), "init")
    solver = part if isinstance(part, PeerSolver) else PnPNet(**{"init": EPnP(), key: part})
    n = values.get("n", 9)
    finite(*solver(PROBLEMS.world_points[:, :n], PROBLEMS.img_points[:, :n], PROBLEMS.intrinsics)[:4])


def costs(loss, values):
    """The loss of a result is finite."""
    n9 = PROBLEMS._replace(world_points=PROBLEMS.world_points[:, :9], img_points=PROBLEMS.img_points[:, :9])
    n9 = n9._replace(inliers=PROBLEMS.inliers[:, :9])
    result, guess = create_solver("pnpnet-set").with_starts(*n9[:3])
    finite(loss(result, n9, 1.0, guess) if isinstance(loss, SetLoss) else loss(result, n9))


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


def mixture(count=2, shares=None, **values):
    mixed = partial(MixedProblems, [SyntheticProblems] * count, shares=shares)
    return VaryingSize(mixed, **{"n": (5, 9), "batch_size": 6, **values}).batch(3)


BOUNDS = {"initial": 3.0, "size": 2, "lower": 1.0, "upper": 50.0}
SAMPLING = {"counts": "iterations seed", "numbers": "threshold confidence", "words": "method"}
SOURCE = "n batch_size seed"
NUMBERS = "translation_box translation_sigma max_angle focal half_image known_noise bunched_share axis_ratio"
NOISES = dict.fromkeys(("img_sigma", "world_sigma", "degrees", "sigma_spread"), ANY | RANGES)
SHARES = "max_ratio mismatch_share near_share structured_share mirrored_share crowd_share structured_angle"
SHARES += " point_crowd_share"
MIX = chosen("count min_count min_inliers max_crowds", SHARES, ranges="near_pixels structured_ratio")
VIEW = "field_of_view window"

#: Per name: a constructor and its options.
PARTS = {
    "RobustWeightedLM": (
        RobustWeightedLM,
        chosen("m by_residual last", "step damping robustness", "kernel update backward", "shared"),
    ),
    "MLPInit": (lambda n=9, **sizes: MLPInit(n, **sizes), chosen("n", "world_scale img_scale")),
    "SetInit": (SetInit, chosen("width layers heads hidden starts")),
    "EPnP": (EPnP, chosen("iterations", "algebraic_weight")),
    "REPPnP": (REPPnP, chosen("null_iterations rigid_iterations", "max_error quantile")),
    "RANSAC": (partial(RANSAC, P3P()), chosen("max_samples seed", "threshold world_threshold confidence", "scorer")),
    "Normalize": (Normalize, chosen(numbers="f_const")),
    "OpenCVPnP": (OpenCVPnP, chosen(words="method")),
    "OpenCVRansac": (OpenCVRansac, chosen(**SAMPLING, flags="refine")),
    "OpenCVUsac": (OpenCVUsac, chosen(**SAMPLING)),
    "KorniaRs": (KorniaRs, chosen("max_iterations seed", "threshold confidence", words="method")),
    "PoseLib": (PoseLib, chosen("min_iterations max_iterations", "threshold confidence")),
    "PyColmap": (PyColmap, chosen("min_iterations max_iterations", "threshold loss_scale")),
}
LOSSES = {
    "PoseLoss": (PoseLoss, chosen(numbers="refined saturation rotation translation init_translation")),
    "SetLoss": (SetLoss, chosen("starts", "refined saturation every weights noise rotation_unit translation_unit")),
}
SOURCES = {
    "SyntheticProblems": (synthetic, chosen(SOURCE, NUMBERS, **NOISES)),
    "SceneProblems": (from_scene, chosen(f"{SOURCE} num_spares", flags="recentre")),
    "BoxPoints": (partial(with_points, BoxPoints), chosen(numbers="half_width z_near depth")),
    "SlabPoints": (partial(with_points, SlabPoints), chosen(numbers="field_of_view", ranges="window distance")),
    "ObjectPoints": (partial(with_points, ObjectPoints), chosen(numbers="field_of_view planar", ranges="distance")),
    "FacadePoints": (partial(with_points, FacadePoints), chosen(ranges=VIEW)),
    "RoomPoints": (partial(with_points, RoomPoints), chosen(ranges=VIEW)),
    "DrivePoints": (partial(with_points, DrivePoints), chosen(ranges=VIEW)),
    "OutlierMix": (partial(with_mix, synthetic), MIX),
    "OutlierMix of a scene": (partial(with_mix, from_scene), MIX),
    "MixedPoints": (
        lambda count=2, shares=None: synthetic(points=MixedPoints([BoxPoints()] * count, shares=shares)),
        chosen(shares=st.lists(ANY, max_size=3), count=st.integers(0, 3)),
    ),
    "VaryingSize": (
        mixture,
        chosen(
            "batch_size seed", n=st.lists(COUNTS, max_size=3), shares=st.lists(ANY, max_size=3), count=st.integers(0, 3)
        ),
    ),
}


def factors_are_sound(settings, values):
    """Learning rates and ramp stay in their bounds."""
    for update in range(13):
        assert 0 <= settings.lr_factor(update) < math.inf
        assert 0 <= settings.ramp_factor(update) <= 1


SETTINGS = {
    "TrainSettings": (
        lambda **values: TrainSettings(**{"updates": 12, **values}),
        chosen("updates warmup max_skipped log_every validate_every", "lr clip final_lr", ranges="ramp"),
    )
}
PARAMETERS = {
    "BoundedParameter": (
        lambda **values: BoundedParameter(**{**BOUNDS, **values}),
        chosen("size", "initial lower upper", flags="logarithmic"),
    )
}
USES = ((PARTS, solves), (LOSSES, costs), (SOURCES, is_sound), (SETTINGS, factors_are_sound))
USES = (*USES, (PARAMETERS, has_its_initial_value))
CASES = {name: (*case, use) for cases, use in USES for name, case in cases.items()}


@pytest.mark.parametrize("name", CASES)
def test_any_options_work_or_are_refused(name):
    make, values_of, use = CASES[name]
    made = Seen()
    try:
        make()
    except ImportError as error:
        pytest.skip(str(error))

    @many(60)
    @given(values_of)
    def run(values):
        product = made(lambda: make(**values))
        if product is not None:
            use(product, values)

    run()
    made.both(1)


#: Options that make no sense, by constructor.
REFUSED = [
    (RobustWeightedLM, {"kernel": "tukey", "update": "se3", "backward": "none", "step": 2.1, "damping": 0.0}),
    (RobustWeightedLM, {"robustness": 3.5, "m": -1, "last": 0, "by_residual": True}),
    (RobustWeightedLM, {"m": 2.5, "by_residual": -1}),
    (PnPNet, {"views": 0}),
    (PnPNet, {"views": 9}),
    (PnPNet, {"views": True}),
    (MLPInit, {"n": 2}),
    (MLPInit, {"n": "9"}),
    (SetInit, {"width": 0, "starts": 0, "layers": 1.5, "samples": 9}),
    (partial(SetInit, width=30), {"heads": 4}),
    (EPnP, {"iterations": 1, "algebraic_weight": -0.1}),
    (REPPnP, {"quantile": 1.1, "max_error": -1.0, "null_iterations": -1, "refine_iterations": 0}),
    (partial(RANSAC, P3P()), {"threshold": math.nan, "world_threshold": -1.0, "scorer": "best", "max_samples": 0}),
    (partial(RANSAC, P3P()), {"min_samples": 1.5, "confidence": 1.0, "local_iterations": -1}),
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
