"""Sets of problems for the command line, from sources (synthetic data, scenes) and numbers of outliers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from kornia.core.exceptions import ValueCheckError

from kornia_pnpnet.data import MixedProblems, OutlierMix, SceneProblems, SlabPoints, SyntheticProblems, load_scene
from kornia_pnpnet.evaluation.comparison import EvaluationData, draw_problems

__all__ = ["DEFAULT_SEED", "PRIORS", "evaluation_sets"]

#: Seed of the problems on which solvers are compared. Nothing is trained or tuned on this seed.
DEFAULT_SEED = 12345

_slab = partial(SyntheticProblems, points=SlabPoints())
#: Synthetic sources by name. Each value holds the name in results files (some are in ``conf/data``), and a constructor.
PRIORS: dict[str, tuple[str, Callable[..., SyntheticProblems | MixedProblems]]] = {
    "synthetic": ("paper", SyntheticProblems),
    "gaussian_pose": ("gaussian_pose", partial(SyntheticProblems, translation_sigma=25.0)),
    "any_rotation": ("any_rotation", partial(SyntheticProblems, max_angle=math.pi)),
    "slab": ("slab", _slab),
    "mixed": ("mixed", partial(MixedProblems, [SyntheticProblems, _slab])),
}

# Number of problems per batch. The number is fixed, so that a set of 100 problems is the start of a set of 1000.
_DRAW_BATCH = 1000


def _read_outliers(text: str, n: int, mismatches_only: bool) -> Iterator[tuple[str, OutlierMix, str | int]]:
    """Parse ``--outliers``. Yield a label, a mix, and the entry of results (``none``, ``uniform`` or an integer)."""
    one, many, share = ("mismatch", "mismatches", 1.0) if mismatches_only else ("outlier", "outliers", 0.5)
    for word in map(str.strip, text.split(",")):
        if word == "uniform":
            mix = OutlierMix(mismatch_share=share)
            yield f"0-{mix.max_count(n)} {many}", mix, "uniform"
            continue
        if word == "none" or word.isdecimal():
            count = 0 if word == "none" else int(word)
        elif re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*%", word, re.ASCII) and float(word[:-1]) <= 100:
            count = OutlierMix(max_ratio=float(word[:-1]) / 100).max_count(n)
        else:
            raise ValueCheckError(
                f"--outliers: expected none, uniform, numbers or shares like 50%, separated by commas, got {word!r}"
            )
        if count > n:
            raise ValueCheckError(f"--outliers: {count} outliers do not fit into n = {n} pairs")
        mix = OutlierMix(count=count, mismatch_share=share)
        yield f"{count} {one if count == 1 else many}", mix, count or "none"


def evaluation_sets(
    sources: Iterable[str | Path],
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
    """Draw sets of problems on the CPU.

    Args:
        sources: names of :data:`PRIORS`, folders with COLMAP models, or ``.npz`` files of raw matches.
        outliers: ``none``, ``uniform``, numbers or shares like ``50%``, separated by commas.
        n: number of pairs per problem, or several such numbers.
        count: number of problems per set.
        seed: seed of the problems.
        metric: whether the scenes are in metres.
        mismatches_only: make every outlier a mismatch, and let no two mismatches share a pixel. Otherwise, about half
            of the outliers are mismatches, and the others have random pixels.
        known_noise: give synthetic problems the standard deviations of the noise. Points and pixels do not change.
        dtype: dtype of the problems, which are drawn in float64 and then converted.

    Returns:
        Sets by name, one for each combination of source, n and outliers. The description of a set has ``source`` (name
        of the prior or of the scene), ``outliers``, ``mismatch_share``, ``seed`` and, for a scene, ``path``.

    Raises:
        BaseError: for invalid sources, outliers or ``n``.
        FileNotFoundError: when a source does not exist.
        ImportError: when a source needs a package that is not installed.
    """
    sizes = list(n) if isinstance(n, Iterable) else [n]
    if min(sizes) < 3:
        raise ValueCheckError(f"--n: a pose needs at least 3 pairs, got {min(sizes)}")
    mixes = [(size, *mix) for size in sizes for mix in _read_outliers(outliers, size, mismatches_only)]
    noise = {"known_noise": 1.0} if known_noise else {}
    sets: dict[str, EvaluationData] = {}
    for source in dict.fromkeys(map(str, sources)):
        try:
            scene = None if source in PRIORS else load_scene(source, metric=metric)
            name = source if scene is None else scene.name
            taken = {key.partition(", n = ")[0] for key in sets}
            name = source if name in taken else name
            if name in taken:
                raise ValueCheckError("an earlier source has the same name: pass a longer path")
            # Raw matches already contain outliers, and the mix adds further outliers.
            added = "+" if scene is not None and source.endswith(".npz") else ""
            suffix = ", noise given" if known_noise and scene is None else ""
            for size, label, mix, number in mixes:
                options: dict[str, Any] = {"n": size, "outliers": mix, "seed": seed, "dtype": dtype}
                description = {"outliers": number, "mismatch_share": mix.mismatch_share, "seed": seed}
                limits: dict[str, Any] = {}
                if scene is None:
                    prior, make = PRIORS[source]
                    problems = draw_problems(make(**options, **noise, batch_size=_DRAW_BATCH), count)
                    origin = {"source": prior}
                else:  # mismatches get pixels of spare points; with `mismatches_only`, no two mismatches share a pixel
                    spares = max(1, mix.max_count(size)) if mismatches_only else 1
                    views = SceneProblems(scene, num_spares=spares, **options, batch_size=_DRAW_BATCH)
                    problems, origin = draw_problems(views, count), {"source": scene.name, "path": source}
                    limits = {"max_translation": views.max_translation, "unit": "m" if scene.metric else ""}
                entry = EvaluationData(problems, **limits, description=origin | description)
                sets[f"{name}, n = {size}, {added}{label}{suffix}"] = entry
        except ValueError as error:
            raise ValueCheckError(f"{source}: {error}") from error
    return sets
