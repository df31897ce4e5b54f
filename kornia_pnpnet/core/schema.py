"""Reading files that anyone may have written, with an error that says what is wrong: JSON by key, CSV by column."""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

__all__ = [
    "RATE",
    "is_count",
    "is_flag",
    "is_mapping_or_none",
    "is_number",
    "is_number_or_none",
    "is_positive",
    "is_share",
    "is_text",
    "is_text_or_none",
    "misfits",
    "read_column",
    "read_json",
    "read_rows",
]


def is_number(value: Any) -> bool:
    """Whether it is a finite number."""
    return type(value) in (int, float) and abs(value) <= sys.float_info.max


def is_number_or_none(value: Any) -> bool:
    """Whether it is a finite number, or ``None``."""
    return value is None or is_number(value)


def is_positive(value: Any) -> bool:
    """Whether it is a finite number above 0."""
    return is_number(value) and value > 0


def is_share(value: Any) -> bool:
    """Whether it is a number in [0, 1]."""
    return is_number(value) and 0 <= value <= 1


def is_count(value: Any) -> bool:
    """Whether it is an integer of at least 0."""
    return type(value) is int and 0 <= value < 2**63


def is_flag(value: Any) -> bool:
    """Whether it is true or false."""
    return isinstance(value, bool)


def is_text(value: Any) -> bool:
    """Whether it is a text."""
    return isinstance(value, str)


def is_text_or_none(value: Any) -> bool:
    """Whether it is a text, or ``None``."""
    return value is None or is_text(value)


def is_mapping_or_none(value: Any) -> bool:
    """Whether it is a mapping, or ``None``."""
    return value is None or isinstance(value, Mapping)


#: A :class:`~kornia_pnpnet.metrics.SuccessRate` as a mapping.
RATE = {"rate": is_share, "low": is_share, "high": is_share, "total": is_count}


def misfits(value: Any, form: Any, name: str = "") -> Iterator[str]:
    """Names of what is missing or not of a form.

    Args:
        value: lists, mappings and what is in them.
        form: a check of a value; of a list, what all of it is; of a mapping, what is under each key (``"*"`` is any,
            ``?`` ends one that may be missing), others may be there.
        name: what comes before the names.

    Example:
        >>> form = {"n": is_count, "names": [is_text], "unit?": is_text}
        >>> list(misfits({"n": -1, "names": ["a", None]}, form))
        ['n', 'names[1]']
    """
    if callable(form):
        if not form(value):
            yield name
    elif isinstance(form, list):
        if not isinstance(value, list):
            yield name
        elif not (callable(form[0]) and all(map(form[0], value))):
            for i, entry in enumerate(value):
                yield from misfits(entry, form[0], f"{name}[{i}]")
    elif not isinstance(value, Mapping):
        yield name
    else:
        for key, inner in form.items():
            for one in value if key == "*" else [key.removesuffix("?")]:
                below = f"{name}.{one}" if name else one
                if one in value:
                    yield from misfits(value[one], inner, below)
                elif not key.endswith("?"):
                    yield below


def read_json(path: str | Path, what: str) -> Any:
    """Read a JSON file.

    Args:
        path: of the file.
        what: it should be, for errors.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: when it is not JSON, which has no NaN and no infinity.
    """

    def refuse(number: str) -> None:
        raise ValueError(f"{number} is no number of JSON")

    try:
        return json.loads(Path(path).read_text(encoding="utf-8"), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"'{path}' is not {what}: {error}") from error


def read_rows(path: str | Path) -> list[dict[str, str]]:
    """Read a CSV file with a header.

    Args:
        path: of the file.

    Returns:
        The rows, at least one.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: when it is not CSV, has no rows, or one has more cells than the header.
    """
    try:
        with Path(path).open(newline="") as file:
            rows = list(csv.DictReader(file))
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"'{path}' is not a CSV file: {error}") from error
    if not rows:
        raise ValueError(f"'{path}' has no rows.")
    for number, row in enumerate(rows, 1):
        if None in row:
            raise ValueError(f"'{path}': row {number} has more cells than the header.")
    return rows


def read_column(
    path: str | Path,
    rows: Sequence[Mapping[str, str]],
    column: str,
    read: Callable[[str], float],
    *,
    gaps: bool = False,
) -> list[float]:
    """The numbers of a column.

    Args:
        path: the file, for errors.
        rows: of :func:`read_rows`.
        column: its name.
        read: makes a number of a cell.
        gaps: whether cells may be empty or not finite; they are NaN then.

    Raises:
        ValueError: when there is no such column, or a cell is no number.
    """
    if column not in rows[0]:
        raise ValueError(f"'{path}' has no column '{column}'.")
    values = []
    for number, row in enumerate(rows, 1):
        try:
            value = math.nan if gaps and not row[column] else read(row[column])
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"'{path}': '{column}' of row {number} is {row[column]!r}.") from error
        if not -math.inf < value < math.inf:
            if not gaps:
                raise ValueError(f"'{path}': '{column}' of row {number} is {row[column]!r}.")
            value = math.nan
        values.append(value)
    return values
