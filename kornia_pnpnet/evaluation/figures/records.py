"""Results files as one table, for the figures of the paper."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sized
from typing import Any

import pandas as pd
import torch

from kornia_pnpnet.evaluation.problem_sets import PRIORS
from kornia_pnpnet.metrics import success_rate

_SYNTHETIC = {name for name, _ in PRIORS.values()}
_PROTOCOL_N = 9
_KEYS = ["source", "outliers", "mismatches", "n", "solver"]
_RATE = ["rate", "low", "high", "total"]


class NothingToDrawError(ValueError):
    """The results hold no data for a figure."""


def require(found: Sized, what: str) -> None:
    """Raise when nothing was found."""
    if not len(found):
        raise NothingToDrawError(f"The results hold no {what} to draw.")


def records(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Read results files. Operation counts and data sets without a source or outliers are left out.

    Returns:
        One row for each source, outliers, kind of outliers, n and solver. Of several, the one with the most problems,
        and of these the last. Columns: ``source`` (``paper``, another prior, or a scene), ``outliers`` (a number,
        ``"uniform"`` for 0 to a third of the pairs, or another text of the file), ``mismatches`` (every outlier shows
        another point), ``n``, ``solver``, ``base`` (the solver's name without the option m), ``m`` (-1 without a number
        in the configuration), ``swept`` (the name sets m), ``scene``, ``us`` (microseconds per problem), ``limit`` (see
        :func:`success_limit`), success in per cent with its interval (``rate``, ``low``, ``high``), and ``total``.
    """
    rows = []
    for result in results:
        for row in result.get("rows", ()):
            data, solver = result["data"][row["data"]], row["solver"]
            description = data.get("description") or {}
            source, outliers = description.get("source"), description.get("outliers")
            if isinstance(source, str) and isinstance(outliers, int | str):
                outliers = 0 if outliers == "none" else outliers
                mismatches = outliers != 0 and description.get("mismatch_share") == 1
                refine = (result["solvers"][solver].get("config") or {}).get("refine")
                m = refine.get("m") if isinstance(refine, Mapping) else None
                base, m = without_m(solver), m if type(m) is int else -1
                key = (source, outliers, mismatches, data["n"], solver, base, m, base != solver)
                more = (source not in _SYNTHETIC, row["us_per_problem"], success_limit(data))
                rows.append((*key, *more, *percent(row["success"])))
    table = pd.DataFrame(rows, columns=[*_KEYS, "base", "m", "swept", "scene", "us", "limit", *_RATE])
    table = table.astype({"outliers": object, "mismatches": bool, "swept": bool, "scene": bool})
    return table.sort_values("total", kind="stable").drop_duplicates(_KEYS, keep="last").sort_index()


def percent(success: Mapping[str, Any]) -> tuple[float, float, float, int]:
    """Rate and interval of a success in per cent, and the number of problems."""
    return 100 * success["rate"], 100 * success["low"], 100 * success["high"], success["total"]


def without_m(solver: str) -> str:
    """The solver's name without the option m."""
    name, _, options = solver.partition(":")
    others = [option for option in options.split(",") if option and not option.startswith("m=")]
    return ":".join([name, *filter(None, [",".join(others)])])


def pooled(table: pd.DataFrame) -> pd.DataFrame:
    """Success over all scenes of a table with one n and one outlier setting, for solvers that solved all scenes."""
    rows = []
    for solver, parts in table.groupby("solver", sort=False):
        if len(parts) == table.source.nunique():
            solved = (parts.rate * parts.total / 100).round().sum()  # a rate in a file has six digits
            rows.append((solver, *percent(success_rate(torch.arange(parts.total.sum()) < solved)._asdict())))
    return pd.DataFrame(rows, columns=["solver", *_RATE])


def success_limit(data: Mapping[str, Any]) -> tuple[float, float, str]:
    """Limits of a success on a data set of a results file: degrees, length, and unit of the length."""
    return data["max_rotation_deg"], data["max_translation"], data["unit"] or "world units"


def limits_in_words(limits: Iterable[tuple[float, float, str]]) -> str:
    """The limits of a success, in words."""
    table = pd.DataFrame(list(limits), columns=["degrees", "length", "unit"])
    lengths = [f"{_span(part.length, '.2g')} {unit}" for unit, part in table.groupby("unit", sort=False)]
    return f"Solved: errors below {_span(table.degrees, 'g')}° and {' or '.join(lengths)}."


def in_words(table: pd.DataFrame) -> str:
    """The limits of a success and the number of problems in each set."""
    return f"{limits_in_words(table.limit)} {_span(table.total, 'd')} problems in each set, 95 % intervals."


def _span(values: pd.Series, form: str) -> str:
    """The value, or the least and the largest value when their texts differ."""
    low, high = f"{values.min():{form}}", f"{values.max():{form}}"
    return low if low == high else f"{low} to {high}"


def outliers_in_words(outliers: int | str, n: int | str = "n") -> str:
    """The number of outliers among ``n`` pairs, for a title."""
    if outliers in (0, "uniform"):
        return f"0 to {'⌊n/3⌋' if isinstance(n, str) else n // 3} outliers of {n}" if outliers else "no outliers"
    return outliers if isinstance(outliers, str) else f"{outliers} outliers of {n}"


def at_usual_n(table: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """The rows at the n of a figure that does not vary n: 9 as in the protocol, or the smallest n."""
    n = _PROTOCOL_N if table.empty or (table.n == _PROTOCOL_N).any() else int(table.n.min())
    return table[table.n == n], n
