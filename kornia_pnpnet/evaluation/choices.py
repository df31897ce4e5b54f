"""What a user can choose by name: solvers and bounds, and problems to compare them on."""

from __future__ import annotations

import importlib.util
import json
import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from kornia.core.exceptions import ValueCheckError
from torch import nn

from kornia_pnpnet.data import (
    MixedProblems,
    OutlierMix,
    Scene,
    SceneProblems,
    SlabPoints,
    SyntheticProblems,
    load_scene,
)
from kornia_pnpnet.evaluation.bounds import KnownInliers, KnownInliersAndNoise
from kornia_pnpnet.evaluation.comparison import EvaluationData, draw_problems
from kornia_pnpnet.registry import create_solver, list_solvers
from kornia_pnpnet.solver import PnPNet

__all__ = ["BOUNDS", "DEFAULT_SEED", "PRIORS", "default_solvers", "evaluation_sets", "load_solver", "missing_package"]

#: Of the problems that solvers are compared on; nothing is trained or tuned on it.
DEFAULT_SEED = 12345

#: Bounds by name: they see the truth, so they can be evaluated but solve nothing.
BOUNDS: dict[str, type[nn.Module]] = {
    "known-inliers": KnownInliers,
    "known-inliers-and-noise": KnownInliersAndNoise,
}

_slab = partial(SyntheticProblems, points=SlabPoints())
#: Synthetic data by the name of a source: what it is called in results (the names of conf/data), and what makes it.
PRIORS: dict[str, tuple[str, Callable[..., SyntheticProblems | MixedProblems]]] = {
    "synthetic": ("paper", SyntheticProblems),
    "gaussian_pose": ("gaussian_pose", partial(SyntheticProblems, translation_sigma=25.0)),
    "any_rotation": ("any_rotation", partial(SyntheticProblems, max_angle=math.pi)),
    "slab": ("slab", _slab),
    "mixed": ("mixed", partial(MixedProblems, [SyntheticProblems, _slab])),
}

# Every competitor of the protocol, in the order of its figures.
_COMPETITORS = (
    "pnpnet-set",
    "pnpnet-n{n}",
    "net-n{n}",
    "identity-lm",
    "epnp",
    "epnp-lm",
    "reppnp",
    "reppnp-lm",
    "ransac-epnp-lm",
    "p3p-ransac",
    "opencv-sqpnp",
    "opencv-epnp",
    "opencv-ransac",
    "opencv-usac",
    "poselib",
    "pycolmap",
)
# On real scenes the points are sharper than on the protocol's data, and threshold methods want lower thresholds. Tried
# were 3 to 60 px with the RANSAC of OpenCV, PoseLib, pycolmap and our P3P, on five scenes with 0, 2 and 4 of 9 pairs
# wrong and problems of another seed: from 6 to 20 px success hardly changes.
_ON_SCENES = {
    **dict.fromkeys(("ransac-epnp-lm", "p3p-ransac"), "threshold=12"),
    **dict.fromkeys(("opencv-ransac", "opencv-usac", "poselib", "pycolmap"), "threshold=12"),
}
# The peers' defaults suit the protocol's data, ours suit sharp points. These do on the protocol's: three to five times
# its noise, the best of a grid from 3 px and 0.15 m to 8 px and 0.4 m on problems of another seed, in which success
# changes by a point.
_ON_PRIORS = dict.fromkeys(("ransac-epnp-lm", "p3p-ransac"), "threshold=5,world_threshold=0.25")
_DRAW_BATCH = 1000  # fixed, so that the first problems are the same however many are asked for
# What solvers need beyond ours, by the beginning of their names.
_PACKAGES = {"opencv-": ("cv2", "OpenCV"), "poselib": ("poselib", "PoseLib"), "pycolmap": ("pycolmap", "pycolmap")}


def load_solver(spec: str) -> nn.Module:
    """Make the solver or the bound that a user named.

    Args:
        spec: a name of :func:`~kornia_pnpnet.list_solvers` or of :data:`BOUNDS`, with options after a colon
            (``"opencv-ransac:threshold=12,refine=false"``), or a folder of weights.

    Returns:
        The solver in evaluation mode. A bound is a :class:`~kornia_pnpnet.evaluation.comparison.SeesTruth`.

    Raises:
        BaseError: for an unknown name or option.
        ImportError: when the solver needs a package that is not installed.
    """
    name, _, text = spec.partition(":")
    if name not in {*list_solvers(), *BOUNDS} and Path(spec).is_dir():
        return PnPNet.from_pretrained(spec)
    options = {}
    for option in filter(None, text.split(",")):
        key, _, value = option.partition("=")
        try:
            options[key] = json.loads(value)
        except ValueError:
            options[key] = value
    if name not in BOUNDS:
        return create_solver(name, **options)
    try:
        return BOUNDS[name](**options).eval()
    except TypeError as error:
        raise ValueCheckError(f"Bound {name!r} does not take these options: {error}.") from error


def _outlier_mix(word: str, n: int, mismatch_share: float) -> OutlierMix:
    """The mix that ``none``, ``uniform``, ``2`` or ``50%`` asks for."""
    if word == "uniform":
        return OutlierMix(mismatch_share=mismatch_share)
    if word == "none" or word.isdecimal():
        count = 0 if word == "none" else int(word)
    else:
        try:
            share = float(word[:-1]) / 100 if word.endswith("%") else -1.0
        except ValueError:
            share = -1.0
        if not 0 <= share <= 1:
            raise ValueCheckError(
                f"--outliers: expected none, uniform, numbers or shares like 50%, with commas, got {word!r}"
            )
        count = OutlierMix(max_ratio=share).max_count(n)
    if count > n:
        raise ValueCheckError(f"--outliers: {count} outliers do not fit into n = {n} pairs")
    return OutlierMix(count=count, mismatch_share=mismatch_share)


def _outlier_mixes(text: str, n: int, mismatches_only: bool) -> dict[str, tuple[OutlierMix, str | int]]:
    """Mixes by their label, and what results call their number: ``none``, ``uniform`` or an integer."""
    one, many = ("mismatch", "mismatches") if mismatches_only else ("outlier", "outliers")
    mixes: dict[str, tuple[OutlierMix, str | int]] = {}
    for word in (part.strip() for part in text.split(",")):
        mix = _outlier_mix(word, n, 1.0 if mismatches_only else 0.5)
        if mix.count is None:
            mixes[f"0-{mix.max_count(n)} {many}"] = mix, "uniform"
        else:
            mixes[f"{mix.count} {one if mix.count == 1 else many}"] = mix, mix.count or "none"
    return mixes


def evaluation_sets(
    sources: Iterable[str],
    outliers: str,
    *,
    n: int | Iterable[int],
    count: int,
    seed: int = DEFAULT_SEED,
    metric: bool = True,
    mismatches_only: bool = False,
    known_noise: bool = False,
    dtype: torch.dtype = torch.float32,
) -> dict[str, EvaluationData]:
    """Draw the problems that a user asked for, on the CPU.

    Args:
        sources: names of :data:`PRIORS`, folders with COLMAP models, or ``.npz`` files of raw matches.
        outliers: ``none``, ``uniform``, numbers or shares like ``50%``, with commas between them.
        n: pairs per problem, one number or several.
        count: problems per set.
        seed: of the problems.
        metric: whether the scenes are in metres.
        mismatches_only: outliers are pixels of other points, each of another one, never anywhere in the image.
        known_noise: whether the solvers are given the noise level of synthetic problems. The problems are the same.
        dtype: of the problems. They are drawn in float64 whatever it is.

    Returns:
        One set for each source, n and mix of outliers, by name. Their descriptions say ``source`` (the prior or the
        scene's name), ``outliers`` (``"none"``, ``"uniform"`` or their number), ``mismatch_share``, ``seed`` and, for
        scenes, ``path``.

    Raises:
        BaseError: when a source or a mix cannot be used.
        FileNotFoundError: when a source is not there.
        ImportError: when a package is missing that a source needs.
    """
    sizes = [n] if isinstance(n, int) else list(n)
    if min(sizes) < 3:
        raise ValueCheckError(f"--n: a pose needs at least 3 pairs, got {min(sizes)}")
    mixes = {size: _outlier_mixes(outliers, size, mismatches_only) for size in sizes}  # checked before any is drawn
    sets: dict[str, EvaluationData] = {}
    for source in dict.fromkeys(sources):
        try:
            scene = None if source in PRIORS else load_scene(source, metric=metric)
            name = source if scene is None else scene.name
            if any(key.startswith(f"{name}, ") for key in sets):
                name = source  # another scene of the same name
            for size in sizes:
                for label, (mix, number) in mixes[size].items():
                    common = {"n": size, "outliers": mix, "seed": seed, "dtype": dtype, "batch_size": _DRAW_BATCH}
                    common |= {"known_noise": 1.0} if known_noise and scene is None else {}
                    # Mismatches alone: each to a point of its own. Several to one point agree on a wrong pose.
                    spares = max(1, mix.max_count(size)) if mismatches_only else 1
                    entry = _evaluation_data(source, scene, count, spares, common)
                    described = {"outliers": number, "mismatch_share": mix.mismatch_share, "seed": seed}
                    # Raw matches have mismatches of their own, to which those of the mix are added.
                    added = "+" if scene is not None and source.endswith(".npz") else ""
                    knows = ", noise told" if known_noise and scene is None else ""
                    sets[f"{name}, n = {size}, {added}{label}{knows}"] = entry._replace(
                        description={**entry.description, **described}
                    )
        except ValueError as error:
            raise ValueCheckError(f"{source}: {error}") from error
    return sets


def _evaluation_data(
    source: str, scene: Scene | None, count: int, num_spares: int, common: Mapping[str, Any]
) -> EvaluationData:
    """Draw the problems of one set; its description says where they are from."""
    if scene is None:
        prior, make = PRIORS[source]
        return EvaluationData(draw_problems(make(**common), count), description={"source": prior})
    drawn = SceneProblems(scene, num_spares=num_spares, **common)
    return EvaluationData(
        draw_problems(drawn, count),
        max_translation=drawn.max_translation,
        unit="m" if scene.metric else "",
        description={"source": scene.name, "path": source},
    )


def default_solvers(n: int | Iterable[int], sources: Iterable[str] = ("synthetic",)) -> list[str]:
    """The protocol's competitors and bounds on problems of ``n`` pairs, as far as they are installed.

    Args:
        n: pairs per problem, one number or several.
        sources: where the problems come from. Threshold methods get thresholds that suit them. When all are scenes, the
            bound that needs the noise is left out.

    Returns:
        What :func:`load_solver` takes.
    """
    sizes = [n] if isinstance(n, int) else list(n)
    names = dict.fromkeys(competitor.format(n=size) for competitor in _COMPETITORS for size in sizes)
    there = list_solvers()
    installed = [name for name in names if name in there and not missing_package(name)]
    synthetic = any(source in PRIORS for source in sources)
    options = _ON_PRIORS if synthetic else _ON_SCENES
    suited = [f"{name}:{options[name]}" if name in options else name for name in installed]
    return [*suited, *(BOUNDS if synthetic else ["known-inliers"])]


def missing_package(solver: str) -> str | None:
    """The name of the package that a solver needs and that is not installed."""
    for beginning, (module, package) in _PACKAGES.items():
        if solver.startswith(beginning) and importlib.util.find_spec(module) is None:
            return package
    return None
