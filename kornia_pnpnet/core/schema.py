"""Reading data that anyone may have written, with an error that names the file and the first wrong entry.

Needs pydantic, which only the extras install: the modules that ``import kornia_pnpnet`` loads must not import this one.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, ValidatorFunctionWrapHandler, WrapValidator

__all__ = ["STRICT", "Count", "Kept", "Positive", "Share", "read_column", "read_json", "read_rows", "to_json"]

_T = TypeVar("_T")

#: A number in [0, 1].
Share = Annotated[float, Field(ge=0, le=1)]
#: A finite number above 0.
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
#: An integer of at least 0 that fits into 64 bits.
Count = Annotated[int, Field(ge=0, lt=2**63)]
#: The configuration of a type whose numbers must be finite; types inside it take it over.
STRICT = ConfigDict(strict=True, allow_inf_nan=False)


def _keep(data: Any, check: ValidatorFunctionWrapHandler) -> Any:
    check(data)
    return data


#: Check the keys that a ``TypedDict`` names, and keep the mapping as it is, with its other keys.
Kept = WrapValidator(_keep)


def read_json(path: str | Path, kind: type[_T], what: str) -> _T:
    """Read a JSON file of a type that pydantic knows.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: when the file is not of this type. The message says that it is not ``what`` (such as "a results
            file") and names the first wrong entry, for example ``rows[0].success.rate``.
    """
    try:
        return TypeAdapter(kind).validate_json(Path(path).read_bytes(), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in first["loc"]).removeprefix(".")
        wrong = first["msg"].removeprefix("Value error, ")
        if first["type"].startswith("missing"):
            wrong = f"{place} is missing"
        elif place:
            wrong = f"{place} is {reprlib.repr(first['input'])}: {wrong}"
        raise ValueError(f"'{path}' is not {what}: {wrong}.") from error


def to_json(value: Any) -> Any:
    """Plain data of dataclasses and named tuples, with their fields as keys."""
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {key: to_json(entry) for key, entry in value.items()}
    return [to_json(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def read_rows(path: str | Path) -> list[dict[str, str]]:
    """Read the rows, at least one, of a CSV file with a header; ``ValueError`` when the file is no such file."""
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
    """Convert a column of :func:`read_rows` to numbers with ``read``.

    With ``gaps``, empty cells and numbers that are not finite become NaN; without, they are a ``ValueError``, as are a
    missing column and other texts. The message names ``path``.
    """
    if column not in rows[0]:
        raise ValueError(f"'{path}' has no column '{column}'.")
    values = []
    for number, cell in enumerate((row[column] for row in rows), 1):
        try:
            value = read(cell) if cell or not gaps else math.nan
            if not gaps and not math.isfinite(value):
                raise ValueError("not finite")
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"'{path}': '{column}' of row {number} is {cell!r}.") from error
        values.append(value if math.isfinite(value) else math.nan)
    return values
