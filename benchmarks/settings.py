"""How much is measured, and on which problems."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from contenders import CONTENDERS, ONE_THREAD, OURS
from harness import say
from tasks import CannotBeTimedError, Contender
from versions import version_contenders

from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation import draw_problems
from kornia_pnpnet.types import Problems

__all__ = ["FULL", "N", "QUICK", "Settings", "draw", "make_contenders", "mismatches"]

#: Pairs where n is not said.
N = 9
# Nothing was trained, tuned or looked at with these problems before.
_SEED = 20_270_400


class Settings(NamedTuple):
    """How much is measured.

    Attributes:
        contenders: names; ``None``: all, versions too.
        device: of the solvers of ours; the others run on the CPU.
        problems: how many success is counted on, and the batch at which numbers of pairs are compared.
        batches: batch sizes at 9 pairs.
        pairs: numbers of pairs.
        most_backward: largest batch with gradients.
        rounds: at most so many.
        loop_s: in a round a loop over problems is cut to so many that it takes this long, and a shorter call repeated.
        call_s: larger batches that would take longer are left out.
        point_s: rounds of one comparison take about so long.
        latency_calls: calls with a single problem.
        latency_s: cut to what takes this long.
        startup_runs: processes for each cold start.
        memory_batch: batch whose memory is measured.
    """

    contenders: tuple[str, ...] | None = None
    device: str = "cpu"
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
    startup_runs: int = 1
    memory_batch: int = 10_000

    @classmethod
    def of(cls, plain: dict[str, Any]) -> Settings:
        """From JSON, which has lists for tuples."""
        values: dict[str, Any] = {key: tuple(x) if isinstance(x, list) else x for key, x in plain.items()}
        return cls(**values)


FULL = Settings()
#: To see that everything runs.
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
    startup_runs=1,
    memory_batch=100,
)


def mismatches(n: int) -> int:
    """How many pairs are wrong: a third."""
    return n // 3


def draw(n: int, count: int, outliers: OutlierMix | None = None) -> Problems:
    """Problems of the protocol's data in float64, a third of the pairs mismatched unless said otherwise."""
    mix = OutlierMix(count=mismatches(n), mismatch_share=1.0) if outliers is None else outliers
    # The batch size is fixed, so that more problems begin with the fewer ones.
    return draw_problems(
        SyntheticProblems(n=n, batch_size=1000, seed=_SEED + n, outliers=mix, dtype=torch.float64), count
    )


class Made(NamedTuple):
    """What :func:`make_contenders` returns."""

    contenders: dict[str, Contender]
    skipped: list[dict[str, Any]]


def make_contenders(settings: Settings, *, versions: bool = False, count: int = 1) -> Made:
    """Make what is asked for, as far as it is installed.

    Args:
        settings: say which, and the device.
        versions: earlier versions of the package, too.
        count: of threads; some are measured on one only.

    Returns:
        Contenders by name, and for those that cannot be made the reason.
    """
    makers: dict[str, Callable[..., Contender]] = {**CONTENDERS, **(version_contenders() if versions else {})}
    wanted = [name for name in makers if settings.contenders is None or name in settings.contenders]
    made, skipped = {}, []
    for name in wanted:
        if count > 1 and name in ONE_THREAD:
            skipped.append({"contender": name, "why": "measured on one thread only"})
            continue
        options = {"device": settings.device} if name in OURS else {}
        try:
            made[name] = makers[name](**options)
        except (ImportError, CannotBeTimedError) as error:
            skipped.append({"contender": name, "why": str(error)})
            say(f"skipped: {name}: {error}")
    return Made(made, skipped)
