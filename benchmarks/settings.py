"""How much is measured, and on which problems."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from contenders import CONTENDERS, ONE_THREAD
from harness import say
from tasks import CannotBeTimedError, Contender

from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation import draw_problems
from kornia_pnpnet.result import Problems

#: Number of pairs unless a row says otherwise.
N = 9
# Seed of the problems. No training or tuning used it.
_SEED = 20_270_400


class Settings(NamedTuple):
    """How much is measured.

    Attributes:
        contenders: names; ``None``: all.
        problems: number of problems that success is counted on, and batch size of the rows with other numbers of pairs.
        batches: batch sizes at 9 pairs.
        pairs: numbers of pairs.
        most_backward: largest batch size with gradients.
        rounds: largest number of rounds.
        loop_s: seconds for a contender in a round: a loop over problems solves fewer, a shorter call is repeated.
        call_s: batches whose call takes more seconds are left out.
        point_s: seconds for all rounds of one comparison, about.
        latency_calls: number of calls with a single problem.
        latency_s: seconds of these calls; slow contenders get fewer calls.
        memory_batch: batch size of the memory measurement.
    """

    contenders: tuple[str, ...] | None = None
    problems: int = 1000
    batches: tuple[int, ...] = (1, 10, 100, 1000, 10_000, 100_000)
    pairs: tuple[int, ...] = (6, 9, 20, 100, 1000)
    most_backward: int = 10_000
    rounds: int = 5
    loop_s: float = 0.2
    call_s: float = 2.0
    point_s: float = 3.0
    latency_calls: int = 1000
    latency_s: float = 2.5
    memory_batch: int = 10_000


FULL = Settings()
#: A few small problems: does everything run?
QUICK = Settings(
    problems=20,
    batches=(1, 20),
    pairs=(6, 9),
    most_backward=20,
    rounds=3,
    loop_s=0.01,
    call_s=600.0,
    point_s=1.0,
    latency_calls=20,
    latency_s=1.0,
    memory_batch=100,
)


def draw(n: int, count: int, outliers: OutlierMix | None = None) -> Problems:
    """Problems of the protocol's data in float64; a third of the pairs are mismatches unless ``outliers`` is given."""
    mix = OutlierMix(count=n // 3, mismatch_share=1.0) if outliers is None else outliers
    # A constant batch size: a smaller count gives the first problems of a larger one.
    source = SyntheticProblems(n=n, batch_size=1000, seed=_SEED + n, outliers=mix, dtype=torch.float64)
    return draw_problems(source, count)


def make_contenders(settings: Settings, *, count: int = 1) -> tuple[dict[str, Contender], list[dict[str, Any]]]:
    """Make the contenders that are asked for.

    Args:
        settings: names.
        count: number of threads; some contenders are measured on one thread only.

    Returns:
        Contenders by name, and for each contender that cannot be made its name and the reason.
    """
    made: dict[str, Contender] = {}
    skipped: list[dict[str, Any]] = []
    for name, make in CONTENDERS.items():
        if settings.contenders is not None and name not in settings.contenders:
            continue
        if count > 1 and name in ONE_THREAD:
            skipped.append({"contender": name, "why": "measured on one thread only"})
            continue
        try:
            made[name] = make()
        except (ImportError, CannotBeTimedError) as error:
            skipped.append({"contender": name, "why": str(error)})
            say(f"skipped: {name}: {error}")
    return made, skipped
