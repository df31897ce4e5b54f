"""What a user can choose by name: solvers, and problems to compare them on."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from kornia.core.exceptions import ValueCheckError
from torch import nn

from kornia_pnpnet.data import OutlierMix, SceneProblems, SyntheticProblems, load_scene
from kornia_pnpnet.evaluation import EvaluationData, draw_problems
from kornia_pnpnet.model import PnPNet
from kornia_pnpnet.registry import create_solver, list_solvers

__all__ = ["DEFAULT_SEED", "default_solvers", "evaluation_sets", "load_solver", "missing_package"]

#: Of the problems that solvers are compared on; nothing is trained or tuned on it.
DEFAULT_SEED = 12345

# On real scenes the points are sharp and OpenCV does best with a lower threshold than on the protocol's data: the
# best of 3 to 60 px over three scenes, on problems of another seed.
_ON_SCENES = {"opencv-ransac": "opencv-ransac:threshold=12"}
_DRAW_BATCH = 1000  # fixed, so that the first problems are the same however many are asked for
_PACKAGES = {"opencv-": ("cv2", "OpenCV")}  # what solvers need beyond ours, by the beginning of their names


def load_solver(spec: str) -> nn.Module:
    """Make the solver that a user named.

    Args:
        spec: a name of :func:`~kornia_pnpnet.list_solvers`, with options of the solver after a colon
            (``"opencv-ransac:threshold=12,refine=false"``), or a folder of weights.

    Returns:
        The solver in evaluation mode.

    Raises:
        BaseError: for an unknown name or option.
        ImportError: when the solver needs a package that is not installed.
    """
    name, _, text = spec.partition(":")
    if name not in list_solvers() and Path(spec).is_dir():
        return PnPNet.from_pretrained(spec)
    options = {}
    for option in filter(None, text.split(",")):
        key, _, value = option.partition("=")
        try:
            options[key] = json.loads(value)
        except ValueError:
            options[key] = value
    return create_solver(name, **options)


def _outlier_mixes(text: str, n: int) -> dict[str, OutlierMix]:
    """Mixes by what to call them, from ``none,uniform,2``."""
    mixes = {}
    for word in (part.strip() for part in text.split(",")):
        if word == "uniform":
            mix = OutlierMix()
            mixes[f"0-{mix.max_count(n)} outliers"] = mix
        elif word == "none" or word.isdecimal():
            count = 0 if word == "none" else int(word)
            if count > n:
                raise ValueCheckError(f"--outliers: {count} outliers do not fit into n = {n} pairs")
            mixes[f"{count} outlier{'' if count == 1 else 's'}"] = OutlierMix(count=count)
        else:
            raise ValueCheckError(f"--outliers: expected none, uniform or numbers with commas, got {text!r}")
    return mixes


def evaluation_sets(
    sources: Iterable[str], outliers: str, *, n: int, count: int, seed: int = DEFAULT_SEED, metric: bool = True
) -> dict[str, EvaluationData]:
    """Draw the problems that a user asked for, in float32 on the CPU.

    Args:
        sources: ``synthetic``, folders with COLMAP models, or ``.npz`` files of raw matches.
        outliers: ``none``, ``uniform`` or numbers, with commas between them.
        n: pairs per problem.
        count: problems per set.
        seed: of the problems.
        metric: whether the scenes are in metres.

    Returns:
        One set for each source and mix of outliers, by name.

    Raises:
        BaseError: when a source or a mix cannot be used.
        FileNotFoundError: when a source is not there.
        ImportError: when a package is missing that a source needs.
    """
    if n < 3:
        raise ValueCheckError(f"--n: a pose needs at least 3 pairs, got {n}")
    mixes = _outlier_mixes(outliers, n)
    common: dict[str, Any] = {"n": n, "batch_size": _DRAW_BATCH, "seed": seed, "dtype": torch.float32}
    sets = {}
    for source in sources:
        try:
            scene = None if source == "synthetic" else load_scene(source, metric=metric)
            for label, mix in mixes.items():
                description = {"source": source, "outliers": label, "seed": seed}
                if scene is None:
                    problems = draw_problems(SyntheticProblems(outliers=mix, **common), count)
                    sets[f"synthetic, {label}"] = EvaluationData(problems, description=description)
                else:
                    drawn = SceneProblems(scene, outliers=mix, **common)
                    # Raw matches have mismatches of their own, to which those of the mix are added.
                    name = f"{scene.name}, {'+' if source.endswith('.npz') else ''}{label}"
                    sets[name if name not in sets else f"{source}, {label}"] = EvaluationData(
                        draw_problems(drawn, count),
                        max_translation=drawn.max_translation,
                        unit="m" if metric else "",
                        description=description,
                    )
        except ValueError as error:
            raise ValueCheckError(f"{source}: {error}") from error
    return sets


def default_solvers(n: int, sources: Iterable[str] = ("synthetic",)) -> list[str]:
    """The solvers worth comparing on problems of ``n`` pairs, as far as they are installed.

    Args:
        n: pairs per problem.
        sources: where the problems come from. When all are scenes, OpenCV's RANSAC gets a threshold that suits them.

    Returns:
        What :func:`load_solver` takes.
    """
    names = [f"pnpnet-n{n}", f"net-n{n}", "identity-lm", "opencv-ransac"]
    names = [name for name in names if name in list_solvers() and not missing_package(name)]
    return names if "synthetic" in sources else [_ON_SCENES.get(name, name) for name in names]


def missing_package(solver: str) -> str | None:
    """The name of the package that a solver needs and that is not installed."""
    for beginning, (module, package) in _PACKAGES.items():
        if solver.startswith(beginning) and importlib.util.find_spec(module) is None:
            return package
    return None
