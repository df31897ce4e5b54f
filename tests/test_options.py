"""Options of all constructors, and arguments of the functions beside the solvers: any works or is refused by us."""

import inspect
import math
from functools import partial

import pytest
import torch
from helpers import ANY, COUNTS, ERRORS, WORD, are_rotations, finite, make_scene, many
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError

import kornia_pnpnet as k
from kornia_pnpnet import MLPInit, Normalize, PnPNet, PoseLoss, RobustWeightedLM, SetInit, SetLoss, create_solver, data
from kornia_pnpnet.cameras import bearings
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.losses import pose_distances
from kornia_pnpnet.metrics import reliability
from kornia_pnpnet.peers import KorniaRs, OpenCVPnP, OpenCVRansac, OpenCVUsac, PeerSolver, PoseLib, PyColmap
from kornia_pnpnet.propose.epnp import EPnP
from kornia_pnpnet.propose.minimal import SubsetSolver
from kornia_pnpnet.propose.p3p import P3P
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.propose.reppnp import REPPnP
from kornia_pnpnet.refine.kernels import BoundedParameter
from kornia_pnpnet.training import TrainSettings

PROBLEMS = data.SyntheticProblems(n=12, batch_size=3, seed=0).batch(0)

#: What is drawn for an option, by its type. Quotients by smaller numbers than 1e-9 may be infinite in float32.
KINDS = {"int": COUNTS, "float": ANY.filter(lambda x: not 0.0 < abs(x) < 1e-9), "str": WORD, "bool": st.booleans()}
KINDS |= dict.fromkeys(("Range", "tuple[float, float]", "Sequence[float]"), st.tuples(ANY, ANY))
KINDS |= {"Sequence[int]": st.lists(COUNTS, max_size=3), "None": st.none()}


@st.composite
def options_of(draw, constructor):
    types = {x.name: x.annotation.split(" | ") for x in inspect.signature(constructor).parameters.values()}
    kinds = {name: [KINDS[x] for x in parts if x in KINDS] for name, parts in types.items() if name != "device"}
    names = draw(st.lists(st.sampled_from(sorted(x for x in kinds if kinds[x])), max_size=2, unique=True))
    return {name: draw(st.one_of(kinds[name])) for name in names}


def solves(part, values):
    key = {RobustWeightedLM: "refine", Normalize: "normalize"}.get(type(part), "init")
    solver = part if isinstance(part, PeerSolver | PnPNet) else PnPNet(**{"init": EPnP(), key: part})
    n = values.get("n", 9)
    finite(*solver(PROBLEMS.world_points[:, :n], PROBLEMS.img_points[:, :n], PROBLEMS.intrinsics)[:4])


def costs(loss, values):
    result, guess = create_solver("pnpnet-set").with_starts(*PROBLEMS[:3])
    finite(loss(result, PROBLEMS, 1.0, guess) if isinstance(loss, SetLoss) else loss(result, PROBLEMS))


def is_sound(problems, values):
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
    return data.SyntheticProblems(**{"batch_size": 4, **values}).batch(0)


def from_scene(**values):
    return data.SceneProblems(make_scene(20, 12), **{"batch_size": 4, **values}).batch(0)


def with_points(prior, **values):
    return synthetic(points=prior(**values))


def mixture(**values):
    mixed = partial(data.MixedProblems, [data.SyntheticProblems] * 2)
    return data.VaryingSize(mixed, **{"n": (5, 9), "batch_size": 6, **values}).batch(3)


def factors_are_sound(settings, values):
    for update in range(13):
        assert 0 <= settings.lr_factor(update) < math.inf
        assert 0 <= settings.ramp_factor(update) <= 1


BOUNDS = {"initial": 3.0, "size": 2, "lower": 1.0, "upper": 50.0}
SOLVER_PARTS = (RobustWeightedLM, SetInit, EPnP, REPPnP, Normalize)
SOLVER_PARTS += (OpenCVPnP, OpenCVRansac, OpenCVUsac, KorniaRs, PoseLib, PyColmap)
PRIORS = (data.BoxPoints, data.FacadePoints, data.RoomPoints, data.DrivePoints)

#: Whose options are drawn, what is made with them, and what the product must do.
CASES = [
    *((part, part, solves) for part in SOLVER_PARTS),
    *((MLPInit, lambda n=9, **sizes: MLPInit(n, **sizes), solves), (RANSAC, partial(RANSAC, P3P()), solves)),
    *((PnPNet, partial(create_solver, name), solves) for name in ("pnpnet-set", "pnpnet-n9", "p3p-ransac", "epnp-lm")),
    *((loss, loss, costs) for loss in (PoseLoss, SetLoss)),
    *((points, partial(with_points, points), is_sound) for points in PRIORS),
    (data.MixedPoints, partial(with_points, partial(data.MixedPoints, [data.BoxPoints()] * 2)), is_sound),
    *((data.SyntheticProblems, synthetic, is_sound), (data.SceneProblems, from_scene, is_sound)),
    (data.OutlierMix, lambda **values: synthetic(outliers=data.OutlierMix(**values)), is_sound),
    (data.OutlierMix, lambda **values: from_scene(outliers=data.OutlierMix(**values)), is_sound),
    (data.VaryingSize, mixture, is_sound),
    (TrainSettings, lambda **values: TrainSettings(**{"updates": 12, **values}), factors_are_sound),
    (BoundedParameter, lambda **values: BoundedParameter(**{**BOUNDS, **values}), has_its_initial_value),
]


@pytest.mark.parametrize(("constructor", "make", "use"), CASES, ids=[case[0].__name__ for case in CASES])
def test_any_options_work_or_are_refused(constructor, make, use):
    outcomes = set()
    try:
        make()
    except ImportError as error:
        pytest.skip(str(error))

    @many(60)
    @given(options_of(constructor))
    def run(values):
        try:
            product = make(**values)
        except ERRORS:
            outcomes.add("refused")
        else:
            outcomes.add("works")
            use(product, values)

    run()
    assert outcomes == {"works", "refused"}


#: Options that make no sense, by constructor.
REFUSED = [
    (RobustWeightedLM, {"kernel": "tukey", "update": "se3", "backward": "truncated", "step": 2.1, "damping": 0.0}),
    (RobustWeightedLM, {"robustness": 3.5, "m": -1, "by_residual": True}),
    *((RobustWeightedLM, {"m": 2.5, "by_residual": -1}), (PnPNet, {"views": 9, "gradient": "never"})),
    (PnPNet, {"views": 0, "focal": "free", "focal_sigma": 0.1, "radial": 1, "effort": "adaptive"}),
    (partial(PnPNet, focal="unknown"), {"views": True, "focal_sigma": 1e-20, "radial": 3}),
    *((MLPInit, {"n": 2}), (MLPInit, {"n": "9"}), (SetInit, {"width": 0, "starts": 0, "layers": 1.5, "samples": 9})),
    *((partial(SetInit, width=30), {"heads": 4}), (EPnP, {"iterations": 1, "algebraic_weight": -0.1})),
    *((REPPnP, {"quantile": 1.1, "max_error": -1.0, "refine_iterations": 0}), (OpenCVPnP, {"method": "NOPE"})),
    (partial(RANSAC, P3P()), {"threshold": math.nan, "world_threshold": -1.0, "scorer": "best", "max_samples": 0}),
    (partial(RANSAC, P3P()), {"min_samples": 1.5, "confidence": 1.0, "final_steps": -1}),
    (OpenCVRansac, {"threshold": math.inf, "iterations": 0, "confidence": 1.0, "seed": -1, "refine": 1}),
    *((partial(SubsetSolver, EPnP()), {"size": 2}), (KnownInliersAndNoise, {"img_sigma": -1.0})),
    *((OpenCVUsac, {"method": method}) for method in ("USAC_FM_8PTS", "SOLVEPNP_EPNP")),
    (KorniaRs, {"threshold": math.inf, "max_iterations": 0, "method": "P3P"}),
    (PyColmap, {"loss_scale": 0.0, "max_iterations": 50}),
    (data.OutlierMix, {"max_ratio": 1.5, "count": -1, "min_count": -1, "mismatch_share": 2.0}),
    (data.OutlierMix, {"near_pixels": (3.0, 1.0), "structured_ratio": (0.0, 0.5), "crowd_share": 1.1, "max_crowds": 0}),
    (data.OutlierMix, {"structured_angle": -1.0, "mirrored_share": 1.5}),
    (data.FacadePoints, {"field_of_view": (15.0, 180.0), "window": (0.1, 1.1)}),
    (data.SyntheticProblems, {"degrees": 0.5, "sigma_spread": 4.0, "bunched_share": -0.1, "half_image": -1.0}),
    (data.SyntheticProblems, {"img_sigma": -1.0, "world_sigma": (0.0, 1.0)}),
    (data.SyntheticProblems, {"img_sigma": (2.0, 1.0), "world_sigma": (1.0, 2.0, 3.0)}),
    (data.CameraProblems, {"n": 0, "field_of_view": (90.0, 30.0), "outlier_share": 2.0, "cameras": 0}),
    (data.CameraProblems, {"field_of_view": (0.0, 30.0), "depth_spread": 0.5}),
    (PoseLib, {"threshold": -1.0, "min_iterations": 0, "progressive_sampling": "yes"}),
    (partial(KnownInliersAndNoise, world_sigma=0.0), {"img_sigma": 0.0}),
    (partial(data.SceneProblems, make_scene(20)), {"n": 0, "batch_size": 0, "num_spares": 0}),
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


def test_a_subclass_has_the_config_of_the_constructor_that_it_calls():
    class Wide(MLPInit):
        def __init__(self, kilopixels):
            super().__init__(9, img_scale=1000.0 * kilopixels)

    assert Wide(2).config == MLPInit(9, img_scale=2000.0).config
    assert "img_scale=2000.0" in repr(Wide(2))


CAMERA, PIXELS, POINTS, DEPTH = torch.eye(3), torch.zeros(2, 5, 2), torch.ones(2, 5, 3), torch.ones(2, 5)
MAPS, ZEROS = torch.zeros(1, 2, 4, 5), torch.zeros(2, 3)
POSES = k.Pose(CAMERA.expand(2, 3, 3), ZEROS)
lifted = partial(k.depth_points, img_points=PIXELS, depth=DEPTH, intrinsics=CAMERA, pose=POSES, depth_sigma=0.1)
covariance = partial(k.pose_covariance, POSES, POINTS, PIXELS, CAMERA)
likelihood = partial(k.monte_carlo_pose_loss, POSES, POSES, world_points=POINTS, img_points=PIXELS, intrinsics=CAMERA)
#: Calls with a wrong argument of the functions beside the solvers.
WRONG = [partial(bearings, x, CAMERA) for x in (PIXELS[..., :1], torch.zeros(2, 5, 3), PIXELS[0, 0])]
WRONG += [partial(bearings, PIXELS[0], CAMERA[None]), partial(bearings, PIXELS[0], CAMERA, fisheye=torch.zeros(1, 4))]
WRONG += [partial(bearings, PIXELS, CAMERA, dist=torch.zeros(5, 4)), partial(lifted, img_points=torch.zeros(2, 5, 3))]
WRONG += [partial(lifted, img_sigma=1.0, img_cov=torch.zeros(2, 5, 2, 2))]
WRONG += [partial(lifted, **x) for x in ({"depth": 2.0}, {"depth": torch.ones(2, 5, 1)}, {"depth_sigma": None})]
WRONG += [partial(k.heatmap_keypoints, x) for x in (torch.zeros(1, 2, 0, 5), torch.zeros(4, 4), MAPS > 0)]
WRONG += [partial(k.heatmap_keypoints, MAPS, x) for x in (0.0, torch.ones(3, 1, 1, 1))]
WRONG += [partial(k.heatmap_keypoints, MAPS, stride=0), partial(reliability, torch.rand(3), torch.ones(3))]
WRONG += [partial(k.success, k.pose_errors(POSES, POSES), max_translation=torch.ones(2, 1))]
WRONG += [partial(reliability, torch.rand(x), torch.ones(y).bool()) for x, y in ((3, 2), (0, 0))]
WRONG += [partial(reliability, torch.tensor(x), torch.ones(2).bool()) for x in ([90.0, 10.0], [0.5, torch.nan])]
WRONG += [partial(reliability, torch.rand(3), torch.ones(3).bool(), 0)]
WRONG += [partial(synthetic, img_sigma=0.0, outliers=data.OutlierMix(near_share=0.5))]
WRONG += [partial(k.gravity_prior, torch.ones(2, 3), torch.ones(3), 0.1), partial(POSES.camera, CAMERA.expand(3, 3, 3))]
WRONG += [partial(pose_distances, POSES, POSES, torch.zeros(3)), partial(k.diagnose, POINTS, POINTS, CAMERA)]
WRONG += [partial(k.pose_errors, k.Pose(*x), POSES) for x in ((CAMERA[None], ZEROS), (CAMERA, ZEROS[0]))]
WRONG += [partial(pose_distances, k.Pose(CAMERA.expand(2, 3, 3), ZEROS[:1]), POSES)]
WRONG += [partial(likelihood, img_sigma=1.0, **x) for x in ({"kernel": "wide"}, {"samples": 3})]
WRONG += [partial(likelihood, img_sigma=1.0, **x) for x in ({"scale": 0.0}, {"rounds": -1})]
WRONG += [partial(k.monte_carlo_pose_loss, POSES, 3, POINTS, PIXELS, CAMERA, img_sigma=1.0)]
WRONG += [partial(covariance, focal=x, focal_sigma=y, img_sigma=1.0) for x, y in (("free", None), ("unknown", 0.0))]
WRONG += [partial(likelihood, world_points=torch.ones(3, 5, 3), img_points=torch.zeros(3, 5, 2), img_sigma=1.0)]
WRONG += [partial(likelihood, img_sigma=1.0, img_cov=torch.zeros(2, 5, 2, 2)), partial(covariance, world_sigma=0.1)]
WRONG += [partial(covariance, img_sigma=1.0, world_sigma=0.1, world_cov=torch.zeros(2, 5, 3, 3)), likelihood]


@pytest.mark.parametrize("call", WRONG, ids=lambda call: call.func.__name__)
def test_wrong_arguments_are_refused(call):
    with pytest.raises(BaseError):
        call()
