"""Laws of all solvers, run by ``test_laws.py``. Each compares the call that :func:`make` draws with a changed call."""

import copy
import math
import pickle
import re
import tempfile
from collections.abc import Callable
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import pytest
import torch
from helpers import assert_same, other_defaults
from kornia.core.exceptions import DeviceError, ShapeError, TypeCheckError, ValueCheckError
from kornia.geometry.calibration import distort_points
from kornia.geometry.camera import distort_points_kannala_brandt
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, normalize_points_with_intrinsics
from torch import Tensor
from torch.nn.functional import pad
from torch.utils import _pytree as pytree

from kornia_pnpnet import PnPNet, PnPResult, Pose, PosePrior, RobustWeightedLM, create_solver
from kornia_pnpnet.data import OutlierMix, SyntheticProblems

CAMERAS, NOISES, FOCALS = ("pixels", "rig", "bearings"), ("none", "sigma", "covariance"), ("known", "unknown")
OPENCV = ("opencv-sqpnp", "opencv-epnp")  # solvers of all pairs
PEERS = (*OPENCV, "opencv-ransac", "opencv-usac", "kornia-rs", "poselib", "pycolmap")
#: Lenses: coefficients of Kornia and OpenCV.
LENSES = {"dist": (-0.2, 0.05, 0.001, -0.002), "fisheye": (0.05, -0.01, 0.002, -0.0005)}
#: Sizes of the problems: of the batch, and of the pairs of each.
BATCH, PAIRS = 5, 12
#: Largest differences in entries of rotations and in translations relative to their length.
TOLERANCE = {torch.float64: 1e-5, torch.float32: 1e-2}

Call = dict[str, Any]


class Case(NamedTuple):
    """One solver with one kind of problems."""

    solver: str
    camera: str = "pixels"
    noise: str = "none"
    focal: str = "known"
    dtype: torch.dtype = torch.float64
    extra: str = ""  # what else is known or unknown: "prior", "confidence", "radial", "dist" or "fisheye"

    def __str__(self) -> str:
        return "-".join([*self[:4], str(self.dtype).removeprefix("torch."), *[self.extra] * bool(self.extra)])

    @property
    def is_refused(self) -> bool:
        """Whether the contract refuses the combination."""
        return self.focal == "unknown" and self.camera != "pixels"

    @property
    def takes_any_n(self) -> bool:
        return "net-n" not in self.solver

    @property
    def is_ransac(self) -> bool:
        """Whether samples are drawn by the places of the pairs."""
        return "ransac" in self.solver


@cache
def build(case: Case) -> PnPNet:
    """The solver of a case, without parameters that require a gradient."""
    options = {"max_samples": 30} if case.solver == "ransac-epnp-lm" else {}
    options |= {"radial": 1} if case.extra == "radial" else {}
    options |= {} if case.solver in PEERS else {"focal": case.focal}
    return create_solver(case.solver, **options).to(case.dtype)


def make(case: Case, batch: int = BATCH, seed: int = 0) -> tuple[Call, Pose]:
    """Arguments of a call, and the true poses. The last pair is an outlier if the solver is robust from its start."""
    # The points are those of the protocol. In a rig every third pair belongs to a camera turned by a third of a turn;
    # bearings are turned to all sides.
    n = PAIRS if case.takes_any_n else int(re.search(r"-n(\d+)", case.solver)[1])
    is_robust = not case.solver.startswith(("epnp", "reppnp", "identity", "net", *OPENCV))
    outliers = int(is_robust and case.focal == "known")
    options = {"axis_ratio": 3.0, "known_noise": 1.0} if case.noise == "covariance" else {}
    options |= {"batch_size": batch, "outliers": OutlierMix(count=outliers), "dtype": torch.float64}
    p = SyntheticProblems(n=n, seed=seed, sigma_spread=0.5, **options).batch(0)
    generator = torch.Generator().manual_seed(seed)
    f = 700.0 + 50.0 * torch.arange(batch, dtype=torch.float64)
    size = (f / p.intrinsics[:, 0, 0])[:, None, None]
    intrinsics = torch.stack((f, f, torch.ones_like(f)), -1).diag_embed()
    intrinsics[:, :2, 2] = torch.tensor([320.0, 240.0])
    pixels = size * p.img_points + intrinsics[:, None, :2, 2]
    call: Call = {"world_points": p.world_points, "img_points": pixels, "intrinsics": intrinsics}
    if case.camera != "pixels":
        number = (torch.arange(n) % 3)[:, None].double()  # of the camera in the rig
        shift = number * torch.tensor([1.0, -2.0, 0.5]).double()
        turn = number * torch.tensor([0.0, 2.0 * math.pi / 3.0, 0.0]).double()
        if case.camera == "bearings":
            turn, shift = 3.0 * torch.rand(n, 3, generator=generator).double(), 0.0 * shift
        rig = Pose(axis_angle_to_rotation_matrix(turn).repeat(batch, 1, 1, 1), shift.repeat(batch, 1, 1))
        if case.camera == "bearings":
            rays = pad(p.img_points / p.intrinsics[:, :1, :1], (0, 1), value=1.0)
            call["img_points"] = _apply(rig.rotation.mT, rays)
        else:
            call |= {"cam_from_rig": rig, "intrinsics": intrinsics[:, None].repeat(1, n, 1, 1)}
        in_rig = _apply(rig.rotation.mT, p.true_cam_points - rig.translation)
        call["world_points"] = (in_rig - p.pose.translation[:, None]) @ p.pose.rotation
    if case.noise == "sigma":
        call["img_sigma"] = size[..., 0] * torch.linspace(0.7, 1.4, n, dtype=torch.float64)
        call["world_sigma"] = torch.linspace(0.04, 0.06, batch, dtype=torch.float64)
    elif case.noise == "covariance":
        call["img_cov"] = size[..., None] ** 2 * p.img_cov
        call["world_cov"] = p.world_cov
    if case.solver == "identity-lm" and case.focal == "known":
        call["init"] = _near(p.pose, generator)
    if case.extra == "prior":
        known = torch.tensor([1e3] * 3 + [0.1] * 3, dtype=torch.float64).diag().repeat(batch, 1, 1)
        call["prior"] = PosePrior(_near(p.pose, generator), known, torch.full((batch,), 3.0, dtype=torch.float64))
    if case.extra == "confidence":
        call["confidence"] = 0.2 + 0.6 * torch.rand(batch, n, generator=generator, dtype=torch.float64)
    if case.extra in LENSES:
        call[case.extra] = torch.tensor(LENSES[case.extra], dtype=torch.float64).repeat(batch, 1)
        call["img_points"] = distorted(pixels, **call)
    if case.focal == "unknown":
        call["intrinsics"][..., [0, 1], [0, 1]] *= 2.0
    return to(case.dtype, call), p.pose


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors[..., None])[..., 0]


def _near(pose: Pose, generator: torch.Generator) -> Pose:
    turn = axis_angle_to_rotation_matrix(0.02 * torch.randn(len(pose.rotation), 3, generator=generator).double())
    return Pose(turn @ pose.rotation, 1.01 * pose.translation)


def distorted(pixels: Tensor, intrinsics: Tensor, dist: Any = None, fisheye: Any = None, **_: Any) -> Tensor:
    """The pixels of a lens at which a pinhole camera sees ``pixels``."""
    if fisheye is None:
        return distort_points(pixels, intrinsics, dist)
    coefficients = torch.cat((intrinsics[:, [0, 1], [0, 1]], intrinsics[:, :2, 2], fisheye), -1)[:, None]
    return distort_points_kannala_brandt(normalize_points_with_intrinsics(pixels, intrinsics), coefficients)


def to(dtype: torch.dtype, tree: Any) -> Any:
    return pytree.tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, tree)


def take(index: Any, tree: Any) -> Any:
    """Some problems of a call or of a result."""
    return pytree.tree_map(lambda x: x if x is None else x[index], tree)


def of_pairs(function: Callable[[Tensor], Tensor], call: Call) -> Call:
    """The call with a function applied to each argument that has an entry for every pair."""
    shape, others = call["world_points"].shape[:2], {name: call[name] for name in ("init", "prior") if name in call}
    return pytree.tree_map(lambda x: function(x) if x.shape[:2] == shape else x, call) | others


def floats(result: PnPResult) -> list[Tensor]:
    return [x for x in pytree.tree_leaves(result) if isinstance(x, Tensor) and x.is_floating_point()]


def assert_near(found: PnPResult, expected: PnPResult) -> None:
    """The same ``ok``, and the same poses, weights and cameras of the problems that are."""
    assert torch.equal(found.ok, expected.ok)
    assert found.ok.any()
    tolerance = TOLERANCE[expected.rotation.dtype]
    found, expected = (take(expected.ok, x._replace(alternatives=None)) for x in (found, expected))
    length, most = expected.translation.norm(dim=-1, keepdim=True), expected.weights.amax(-1, keepdim=True)
    assert_same(found.rotation, expected.rotation, tolerance, tolerance)
    assert_same(found.translation / length, expected.translation / length, tolerance, tolerance)
    assert_same(found.weights / most, expected.weights / most, atol=min(0.1, 1000 * tolerance))
    assert_same(found.intrinsics, expected.intrinsics, 10 * tolerance, tolerance)


def sound(case: Case) -> None:
    """Shapes, dtypes, rotations; the inputs stay as they are; most problems are solved."""
    call, truth = make(case)
    before = pytree.tree_map(torch.clone, call)
    result, n = build(case)(**call), call["world_points"].shape[1]
    shapes = [(BATCH, 3, 3), (BATCH, 3), (BATCH, n), (BATCH,), (BATCH,), (BATCH, 4, 4)]
    assert [tuple(x.shape) for x in (*result[:5], result.matrix)] == shapes
    assert result.ok.dtype == torch.bool
    assert {x.dtype for x in floats(result)} == {case.dtype}
    assert all(x.isfinite().all() for x in floats(result))
    eye = torch.eye(3, dtype=case.dtype).expand(BATCH, 3, 3)
    torch.testing.assert_close(result.rotation @ result.rotation.mT, eye, rtol=0, atol=1e-5)
    assert_same(call, before)
    if not case.solver.startswith("net-"):  # the first guess of a network is coarse
        turn = (result.rotation.double() @ truth.rotation.mT).diagonal(dim1=1, dim2=2).sum(-1)
        assert (turn[result.ok] > 2.99).double().mean() > 0.7
        assert result.ok.double().mean() > 0.7


def batches_are_free(case: Case) -> None:
    """A problem alone is that problem in a batch, and there may be any leading dimensions or none."""
    call, truth = make(case)
    solver = build(case)
    result = solver(**call)
    at = int(result.ok.nonzero()[-1])
    assert_near(solver(**take(slice(at, at + 1), call)), take(slice(at, at + 1), result))
    single = solver(**take(at, call))
    assert single.matrix.shape == (4, 4)
    assert_near(take(None, single), take(slice(at, at + 1), result))
    nested = pytree.tree_map(lambda x: x.unflatten(0, (1, BATCH, 1)), call)
    calls = [nested]
    if case.camera != "rig":  # Kornia's cameras are one batch
        calls.append({**nested, "intrinsics": to(case.dtype, truth).camera(call["intrinsics"])})
    for same in (solver(**x) for x in calls):
        assert same.matrix.shape == (1, BATCH, 1, 4, 4)
        assert_same(pytree.tree_map(lambda x: x.flatten(0, 2), same), result)


def shuffled_is_ordered(case: Case) -> None:
    """The order of the pairs does not matter."""
    call, _ = make(case)
    result = build(case)(**call)
    order = torch.randperm(call["world_points"].shape[1], generator=torch.Generator().manual_seed(0))
    shuffled = build(case)(**of_pairs(lambda x: x[:, order], call))
    assert_near(shuffled, result._replace(weights=result.weights[:, order]))


def padding_is_nothing(case: Case) -> None:
    """Pairs that are masked or weigh nothing change nothing, have weight 0, and may hold any numbers."""
    call, _ = make(case)
    batch, n = call["world_points"].shape[:2]
    there = n - 2
    mask = (torch.arange(n) < there).expand(batch, n)
    few = of_pairs(lambda x: x[:, :there], call) if case.takes_any_n else {**call, "mask": mask}
    expected = build(case)(**few)

    def cut(result: PnPResult) -> PnPResult:
        cameras = result.intrinsics[:, :there] if result.intrinsics.ndim == 4 else result.intrinsics
        return result._replace(weights=result.weights[:, :there], intrinsics=cameras)

    def spoil(x: Tensor) -> Tensor:
        value = math.nan if absent is masked else -1.0
        return torch.cat((x[:, :there], torch.full_like(x[:, there:], value)), 1)

    masked, weightless = {"mask": mask}, {"weights": mask.to(case.dtype)}
    for absent in (masked,) if case.solver in PEERS else (masked, weightless):
        found = build(case)(**of_pairs(spoil, call), **absent)
        assert not found.weights[:, there:].any()
        assert_near(cut(found), cut(expected))


def unknown_sigmas_are_ignored(case: Case) -> None:
    """Without a known sigma, nothing changes. A refiner takes an unknown sigma for the mean of the known ones."""
    call, _ = make(case)
    nan = torch.full_like(call["world_points"][..., 0], math.nan)
    assert_near(build(case)(**call, img_sigma=nan), build(case)(**call))
    if not case.solver.endswith("-set"):
        some = torch.where(torch.arange(nan.shape[1]) % 2 > 0, 2.0, nan)
        assert_near(build(case)(**call, img_sigma=some), build(case)(**call, img_sigma=2.0))


def units_are_free(case: Case) -> None:
    """World, pixels and weights may count in any unit, together with all that is measured in it."""
    call, _ = make(case)
    pixel, weight = 0.25, 1e30 if case.dtype == torch.float64 else 1e6
    result = build(case)(**call)
    for length in (2.0**-40, 2.0**60):
        scale = torch.tensor([pixel, pixel, 1.0], dtype=case.dtype)[:, None]
        factors = {"world_points": length, "world_sigma": length, "world_cov": length**2}
        factors |= {"intrinsics": scale, "img_sigma": pixel, "img_cov": pixel**2}
        factors["img_points"] = 1.0 if case.camera == "bearings" else pixel
        changed = {name: factors.get(name, 1.0) * x if isinstance(x, Tensor) else x for name, x in call.items()}
        for name in {"init", "cam_from_rig"} & call.keys():
            changed[name] = Pose(call[name].rotation, length * call[name].translation)
        if "prior" in call:
            unit = torch.tensor([1.0] * 3 + [length] * 3, dtype=case.dtype)
            pose = Pose(call["prior"].pose.rotation, length * call["prior"].pose.translation)
            changed["prior"] = PosePrior(pose, call["prior"].information / unit / unit[:, None], call["prior"].scale)
        if case.is_ransac:  # whose threshold is in pixels
            changed |= {name: x for name, x in call.items() if name.startswith("img") or name == "intrinsics"}
            scale = torch.ones_like(scale)
        found = build(case)(**changed, weights=torch.full_like(call["world_points"][..., 0], weight))
        back = {"translation": found.translation / length, "intrinsics": found.intrinsics / scale}
        assert_near(found._replace(**back, weights=found.weights / weight), result)


def reflections_are_free(case: Case) -> None:
    """A negative focal length reflects an axis of the image. If the pixels follow, nothing else changes."""
    call, _ = make(case)
    result = build(case)(**call)
    for signs in ((-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (-1.0, -1.0, 1.0)):
        flip = torch.tensor(signs, dtype=case.dtype)
        factors = {"intrinsics": flip[:, None]}
        if case.camera != "bearings":  # a camera of bearings is only a unit
            factors |= {"img_points": flip[:2], "img_cov": flip[:2, None] * flip[:2]}
        changed = {name: factors.get(name, 1.0) * x if isinstance(x, Tensor) else x for name, x in call.items()}
        found = build(case)(**changed)
        assert_same(found._replace(intrinsics=flip[:, None] * found.intrinsics), result)


def frames_are_free(case: Case) -> None:
    """Poses follow a move of the world; they follow a turn, too, unless the first guess is a network of coordinates."""
    call, _ = make(case)
    result = build(case)(**call)
    turn = axis_angle_to_rotation_matrix(torch.tensor([[0.4, -0.9, 0.7]], dtype=torch.float64)).to(case.dtype)[0]
    turn = turn if case.takes_any_n else torch.eye(3, dtype=case.dtype)
    # Of a prior the information would change, because a turn about another origin is another move.
    shift = torch.tensor([30.0, -20.0, 10.0], dtype=case.dtype) * (case.extra != "prior")

    def followed(pose: Pose) -> Pose:  # x_cam = R a + t with a = Qᵀ (a' - c)
        rotation = pose.rotation @ turn.mT
        return Pose(rotation, pose.translation - rotation @ shift)

    changed = {**call, "world_points": call["world_points"] @ turn.mT + shift}
    if "world_cov" in call:
        changed["world_cov"] = turn @ call["world_cov"] @ turn.mT
    if "init" in call:
        changed["init"] = followed(call["init"])
    if "prior" in call:
        changed["prior"] = call["prior"]._replace(pose=followed(call["prior"].pose))
    found = build(case)(**changed)
    assert_near(found, result._replace(**followed(result.pose)._asdict()))


def _line(call: Call, i: int) -> None:
    along = torch.arange(call["world_points"].shape[1], dtype=call["world_points"].dtype)[:, None]
    call["world_points"][i] = along * torch.tensor([1.0, 2.0, -1.0], dtype=along.dtype)


def _put(name: str, at: Any, value: float) -> Callable[[Call, int], None]:
    def spoil(call: Call, i: int) -> None:
        call[name][i][at] = value

    return spoil


#: What makes a problem impossible, by the argument that it needs. From a start that is no pose it may still be solved.
BAD: dict[str, tuple[str, Callable[[Call, int], None]]] = {
    "nan point": ("world_points", _put("world_points", (0, 1), math.nan)),
    "infinite pixel": ("img_points", _put("img_points", (2, 0), math.inf)),
    "only nan": ("world_points", _put("world_points", ..., math.nan)),
    "a line": ("world_points", _line),
    "one point": ("world_points", _put("world_points", ..., 1.5)),
    "two pairs": ("weights", _put("weights", slice(2, None), 0.0)),
    "negative weight": ("weights", _put("weights", 0, -1e-3)),
    "no focal length": ("intrinsics", _put("intrinsics", (..., 0, 0), 0.0)),
    "nan camera": ("intrinsics", _put("intrinsics", (..., 1, 2), math.nan)),
    "no pinhole": ("intrinsics", _put("intrinsics", (..., 2, 0), 1e-3)),
    "mirrored rig": ("cam_from_rig", lambda call, i: call["cam_from_rig"].rotation[i, 2].neg_()),
    "negative sigma": ("img_sigma", _put("img_sigma", 3, -1.0)),
    "infinite length": ("world_sigma", _put("world_sigma", ..., math.inf)),
    "indefinite pixel": ("img_cov", _put("img_cov", (1, [0, 1], [1, 0]), 1e4)),
    "negative ellipsoid": ("world_cov", _put("world_cov", (1, [0, 1, 2], [0, 1, 2]), -1e-9)),
    **{f"nan {lens}": (lens, _put(lens, 0, math.nan)) for lens in LENSES},
    "nan rig": ("cam_from_rig", lambda call, i: call["cam_from_rig"].translation[i, 2, 0].fill_(math.nan)),
    "nan prior": ("prior", lambda call, i: call["prior"].pose.rotation[i, 0, 0].fill_(math.nan)),
    "negative information": ("prior", lambda call, i: call["prior"].information[i, 5, 5].fill_(-1.0)),
    "lopsided information": ("prior", lambda call, i: call["prior"].information[i, 0, 1].fill_(1e5)),
    "prior without scale": ("prior", lambda call, i: call["prior"].scale[i].fill_(0.0)),
    "confidence in percent": ("confidence", _put("confidence", ..., 95.0)),
    "nan start": ("init", lambda call, i: call["init"].rotation[i, 0, 0].fill_(math.nan)),
}


def make_bad(case: Case) -> tuple[list[str], Call, Call]:
    """Kinds of impossible problems, a sound call, and the call whose second, fourth, … problem is of these kinds."""
    kinds = [kind for kind in BAD if BAD[kind][0] in (*make(case, 1)[0], "weights")]
    if case.camera == "bearings":  # of a camera they need the focal length alone
        kinds = [kind for kind in kinds if kind not in ("nan camera", "no pinhole")]
    call, _ = make(case, 2 * len(kinds) + 1)
    call["weights"] = torch.ones_like(call["world_points"][..., 0])
    spoiled = pytree.tree_map(torch.clone, call)
    for i, kind in enumerate(kinds):
        BAD[kind][1](spoiled, 2 * i + 1)
    return kinds, call, spoiled


def bad_problems_fail_alone(case: Case) -> None:
    """They are not ok and finite, say why, have no gradient, and no other problem changes by a bit."""
    kinds, call, spoiled = make_bad(case)
    leaves = [x.requires_grad_() for x in pytree.tree_leaves(spoiled)]
    result = build(case)(**spoiled)
    assert_same(take(slice(0, None, 2), result), take(slice(0, None, 2), build(case)(**call)))
    assert torch.equal(result.status == 0, result.ok)
    for kind, ok in zip(kinds, result.ok[1::2].tolist(), strict=True):
        assert kind == "nan start" or (case.solver in OPENCV and kind == "a line") or not ok, kind
    # The cameras of rigs and bearings come back as they were given.
    answers = floats(result if case.camera == "pixels" else result._replace(intrinsics=None))
    assert all(x.isfinite().all() for x in answers)
    # Every output may enter a loss: all gradients are finite, and 0 where there is no answer.
    bad = ~result.ok & (torch.arange(len(result.ok)) % 2 == 1)
    outputs = [x for x in answers if x.requires_grad]
    for some in (torch.ones_like(bad), bad) if outputs else ():
        total = sum(x[some].sum() for x in outputs)
        gradients = torch.autograd.grad(total, leaves, retain_graph=True, materialize_grads=True)
        assert all(x.isfinite().all() for x in gradients)
    assert not outputs or not any(x.any() for x in gradients)
    if not {"init", "prior"} & call.keys():
        hopeless = build(case)(**{**call, "world_points": torch.full_like(call["world_points"], math.nan)})
        assert torch.equal(hopeless.rotation, torch.eye(3, dtype=case.dtype).expand_as(hopeless.rotation))
        assert not hopeless.ok.any()
        assert not hopeless.weights.any()


def gradients_reach_the_inputs(case: Case) -> None:
    """Of each problem that is ok to points, pixels, cameras and noise; finite everywhere."""
    call = pytree.tree_map(lambda x: x.clone().requires_grad_(), make(case)[0])
    result, names = build(case)(**call), [name for name in call if name != "init"]
    leaves = [pytree.tree_leaves(call[name])[0] for name in names]
    total = result.rotation[:, 0].sum() + result.translation.sum()
    gradients = torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True)
    assert result.ok.any()
    for name, gradient in zip(names, gradients, strict=True):
        assert gradient.isfinite().all(), name
        there = gradient.reshape(BATCH, -1).any(1)
        if name in ("world_points", "img_points") or (name == "intrinsics" and case.camera != "bearings"):
            assert there[result.ok].all(), name
        assert not there[~result.ok].any(), name


def isotropic_covariances_are_sigmas(case: Case) -> None:
    call, _ = make(case)
    sigma = call.pop("img_sigma")
    call["world_sigma"] = 0.0  # what its projection adds to a pixel is not isotropic
    covariance = sigma.square()[..., None, None] * torch.eye(2, dtype=case.dtype)
    results = []
    for noise in ({"img_sigma": sigma}, {"img_cov": covariance}):
        leaf = call["img_points"].clone().requires_grad_()
        result = build(case)(**{**call, "img_points": leaf}, **noise)
        (gradient,) = torch.autograd.grad(result.rotation[..., 0].sum() + result.weights.sum(), leaf)
        results.append((result, gradient))
    (expected, by_sigma), (found, by_covariance) = results
    assert_near(found, expected)
    if case.dtype == torch.float64:
        least = 1e-6 if case.focal == "known" else 1e-2  # the search of the focal length is in float32
        assert_same(by_covariance, by_sigma, 1e-4, least * by_sigma.abs().max().item())
    with pytest.raises(ValueCheckError, match="img_sigma or img_cov"):
        build(case)(**call, img_sigma=sigma, img_cov=covariance)


def half_precision_is_converted(case: Case) -> None:
    """Half precision is solved as full precision, also under autocast; each input has a gradient of its own dtype."""
    cast = torch.bfloat16 if case.dtype == torch.float32 else torch.float16
    call, _ = make(case)
    halves = to(cast, call)
    if case.dtype == torch.float64:  # one input of float64 is enough
        halves["img_points"] = call["img_points"]
    outcomes = []
    for inputs, enabled in ((to(case.dtype, halves), False), (halves, True)):
        inputs = pytree.tree_map(lambda x: x.detach().clone().requires_grad_(), inputs)
        with torch.autocast("cpu", dtype=cast, enabled=enabled):
            result = build(case)(**inputs)
        total = sum(x.sum() for x in floats(result)) + 0.0 * inputs["img_points"].sum()  # a peer has no gradient
        leaves = pytree.tree_leaves(inputs)
        outcomes.append((result, torch.autograd.grad(total, leaves, materialize_grads=True)))
    (expected, full), (found, half) = outcomes
    assert_same(found, expected)
    assert expected.rotation.dtype == case.dtype
    for one, other, leaf in zip(half, full, leaves, strict=True):
        size = 4.0 * torch.finfo(cast).eps * other.abs().max().item()  # sums over the uses of an input
        assert_same(one, other.to(leaf.dtype), atol=size)


def defaults_are_free(case: Case) -> None:
    """PyTorch's default dtype and default device change no bit."""
    call, _ = make(case)
    call |= {"alternatives": 1} if case.camera == "pixels" and case.solver not in PEERS else {}
    solver = build(case)
    expected = solver(**call)
    with other_defaults(torch.float64 if case.dtype == torch.float32 else torch.float16):
        found = solver(**call)
    assert_same(found, expected)


def copies_are_the_same(case: Case) -> None:
    """Copied and pickled; saved and loaded again, unless it is a sampler."""
    call, _ = make(case)
    solver = build(case)
    copies = [copy.deepcopy(solver), pickle.loads(pickle.dumps(solver)), solver.with_options()]
    if not case.is_ransac:
        with tempfile.TemporaryDirectory() as folder:
            solver.save_pretrained(folder)
            copies.append(PnPNet.from_pretrained(folder).to(case.dtype))
    for copied in copies:
        assert (copied.config(), copied.options) == (solver.config(), solver.options)
        assert_same(copied(**call), solver(**call))


def wrong_arguments_are_refused(case: Case) -> None:
    """With a typed error that names the argument."""
    call, _ = make(case)
    weights = torch.ones_like(call["world_points"][..., 0])
    call |= {"weights": weights, "mask": weights > 0}
    leaves, spec = pytree.tree_flatten(call)
    names = [name for name, value in call.items() for _ in pytree.tree_leaves(value)]
    wrong: list[tuple[Callable[[Tensor], Any], type[Exception]]] = [
        (lambda x: x[:-1], ShapeError),
        (lambda x: x[..., None], ShapeError),
        (lambda x: x.cfloat(), TypeCheckError),
        (lambda x: x.bool() if x.is_floating_point() else x.float(), TypeCheckError),
        (lambda x: [1.0], TypeCheckError),
        (lambda x: x.to("meta"), DeviceError),
    ]
    for (i, name), (spoil, error) in product(enumerate(names), wrong):
        with pytest.raises(error, match=name if error is not DeviceError else "on meta"):
            build(case)(**pytree.tree_unflatten([*leaves[:i], spoil(leaves[i]), *leaves[i + 1 :]], spec))
    with pytest.raises(ShapeError, match=r"3 pairs.*2"):
        build(case)(**of_pairs(lambda x: x[:, :2], call))


#: Laws about problems that are ``ok``. The first guess of a network is not.
OF_BELIEVED = (batches_are_free, shuffled_is_ordered, units_are_free, frames_are_free)
NOT_OF_PEERS = (shuffled_is_ordered, units_are_free, frames_are_free, gradients_reach_the_inputs, copies_are_the_same)
LAWS = [sound, *OF_BELIEVED, padding_is_nothing, reflections_are_free, bad_problems_fail_alone]
LAWS += [gradients_reach_the_inputs, isotropic_covariances_are_sigmas, half_precision_is_converted]
LAWS += [defaults_are_free, copies_are_the_same, wrong_arguments_are_refused, unknown_sigmas_are_ignored]


def applies(law: Callable[[Case], None], case: Case) -> bool:
    """Whether the contract promises the law to the solver."""
    # A first guess alone may come from a sample, which is a constant, and a network of a fixed number of pairs makes
    # nothing of fewer without a refinement.
    if law is isotropic_covariances_are_sigmas:
        return case.noise == "sigma"
    if law is unknown_sigmas_are_ignored:
        return case.noise == "none" and case.solver not in PEERS and not case.solver.startswith("net-")
    if case.solver in PEERS:
        return law not in NOT_OF_PEERS
    of_networks = gradients_reach_the_inputs, padding_is_nothing, *OF_BELIEVED
    return not (case.solver.startswith("net-") and law in of_networks)


def gradcheck_by_size(function: Callable[..., Any], call: Call, atol: float) -> None:
    """Each input moves relative to its own size, so that one difference step suits all."""
    leaves, spec = pytree.tree_flatten(call)
    sizes = [x.abs().mean() if x.shape[1:] in ((PAIRS, 2), (PAIRS, 3)) else x for x in leaves]

    def run(*changes: Tensor) -> Any:
        moved = [x + size * d for x, size, d in zip(leaves, sizes, changes, strict=True)]
        return function(**pytree.tree_unflatten(moved, spec))

    changes = [torch.zeros_like(x).requires_grad_() for x in leaves]
    assert torch.autograd.gradcheck(run, changes, eps=1e-6, atol=atol, rtol=1e-3, fast_mode=True)


def gradcheck(case: Case) -> None:
    """Derivatives by all inputs are those of the result: of a refinement that starts near the truth, in float64."""
    call, _ = make(case._replace(solver="identity-lm"), 1)
    call["weights"] = torch.linspace(0.6, 1.4, PAIRS, dtype=torch.float64)[None]
    lm = RobustWeightedLM(3, kernel="cauchy", robustness=5.0, learnable=False)
    if case.focal == "unknown":  # from a start that is a constant to the minimum
        lm = RobustWeightedLM(12, robustness=0.0, damping=1e-6, learnable=False)
    solver = PnPNet(None, lm, focal=case.focal, radial=int(case.extra == "radial"))

    def run(**inputs: Any) -> tuple[Tensor, ...]:
        result = solver(**inputs)
        outputs = result.rotation, result.translation / 10.0, result.weights, result.cost
        return outputs if case.focal == "known" else (*outputs[:2], result.intrinsics[:, 0, 0].log(), result.dist)

    assert solver(**call).ok.all()
    gradcheck_by_size(run, call, atol=1e-4)
