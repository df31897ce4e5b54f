"""Reading data that anyone may have written, with an error that names the wrong entry: JSON by key, CSV by column."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import reprlib
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    NamedTuple,
    NotRequired,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

__all__ = ["Count", "Positive", "Rule", "Share", "from_json", "read_column", "read_json", "read_rows", "to_json"]

_T = TypeVar("_T")


class Rule(NamedTuple):
    """What a value must satisfy, as an argument of ``Annotated``: its wording for errors, and its test."""

    expected: str
    holds: Callable[[Any], bool]


#: A number in [0, 1].
Share = Annotated[float, Rule("a number in [0, 1]", lambda value: 0 <= value <= 1)]
#: A finite number above 0.
Positive = Annotated[float, Rule("a finite number above 0", lambda value: value > 0)]
#: An integer of at least 0 that fits into 64 bits.
Count = Annotated[int, Rule("an integer of at least 0", lambda value: 0 <= value < 2**63)]

# The exact types, since a bool is an int to `isinstance`. JSON writes 1.0 as 1: integers are numbers, too.
_RULES = {
    Any: Rule("anything", lambda value: True),
    NoneType: Rule("null", lambda value: value is None),
    bool: Rule("true or false", lambda value: type(value) is bool),
    int: Rule("an integer", lambda value: type(value) is int),
    float: Rule("a finite number", lambda value: type(value) in (int, float) and abs(value) <= sys.float_info.max),
    str: Rule("a text", lambda value: isinstance(value, str)),
}


def from_json(kind: type[_T], data: Any, name: str = "") -> _T:
    """Check data against a type and build a value of this type.

    Args:
        kind: ``Any``, ``bool``, ``int``, ``float`` (finite), ``str``, one of them ``Annotated`` with a :class:`Rule`, a
            ``list``, a ``dict`` with keys of any text, an optional type, a dataclass, a named tuple or a ``TypedDict``.
        data: lists, mappings and plain values, for example of :func:`read_json`. A mapping may have more keys than its
            type: a ``TypedDict`` keeps them, a dataclass and a named tuple leave them out.
        name: of the data, the beginning of the names in errors.

    Returns:
        The data, with dataclasses and named tuples in place of mappings.

    Raises:
        ValueError: when a key is missing or a value is not of its type; the message names the first one.

    Example:
        >>> class Point(NamedTuple):
        ...     x: float
        ...     weight: Share = 1.0
        >>> from_json(list[Point], [{"x": 3.0}], "points")
        [Point(x=3.0, weight=1.0)]
        >>> from_json(list[Point], [{"x": 3.0}, {"x": 0, "weight": 2}], "points")
        Traceback (most recent call last):
        ValueError: points[1].weight is 2, expected a number in [0, 1]
    """
    value: _T = _read(kind, data, name)
    return value


def to_json(value: Any) -> Any:
    """Plain data of dataclasses and named tuples, what :func:`from_json` reads."""
    if dataclasses.is_dataclass(value):
        return {field.name: to_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {key: to_json(entry) for key, entry in value.items()}
    return [to_json(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def _read(kind: Any, data: Any, name: str) -> Any:
    rule = _rule(kind)
    if rule is not None:
        return data if rule.holds(data) else _refuse(name, data, rule.expected)
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        (inner,) = (part for part in parts if part is not NoneType)
        return None if data is None else _read(inner, data, name)
    if origin is list:
        entry_rule = _rule(parts[0])
        if not isinstance(data, list):
            _refuse(name, data, "a list")
        if entry_rule is not None and all(map(entry_rule.holds, data)):  # names are made for wrong entries only: fast
            return data
        return [_read(parts[0], entry, f"{name}[{i}]") for i, entry in enumerate(data)]
    if not isinstance(data, Mapping):
        _refuse(name, data, "a mapping")
    below = f"{name}." if name else ""
    if origin in (dict, Mapping):
        return {key: _read(parts[1], entry, f"{below}{key}") for key, entry in data.items()}
    fields = {}
    for key, (hint, optional) in _fields(kind).items():
        if key in data:
            fields[key] = _read(hint, data[key], f"{below}{key}")
        elif not optional:
            raise ValueError(f"{below}{key} is missing")
    return {**data, **fields} if is_typeddict(kind) else kind(**fields)


def _refuse(name: str, value: Any, expected: str) -> Any:
    raise ValueError(f"{name or 'the data'} is {reprlib.repr(value)}, expected {expected}")


@cache
def _rule(kind: Any) -> Rule | None:
    """The rule of a type of values without parts; ``None`` for other types."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        base, own = _rule(parts[0]), parts[1]
        return base and Rule(own.expected, lambda value: base.holds(value) and own.holds(value))
    if origin in (Union, UnionType):
        rules = [rule for rule in map(_rule, parts) if rule is not None]
        expected = " or ".join(rule.expected for rule in rules)
        whole = len(rules) == len(parts)
        return Rule(expected, lambda value: any(rule.holds(value) for rule in rules)) if whole else None
    return _RULES.get(kind)


@cache
def _fields(kind: Any) -> dict[str, tuple[Any, bool]]:
    """Type of each field of a record, and whether the field may be missing."""
    hints = get_type_hints(kind, include_extras=True)
    if is_typeddict(kind):
        optional = {key for key, hint in hints.items() if get_origin(hint) is NotRequired}
        return {key: (get_args(hint)[0] if key in optional else hint, key in optional) for key, hint in hints.items()}
    if dataclasses.is_dataclass(kind):
        unset = dataclasses.MISSING
        fields = dataclasses.fields(kind)
        return {x.name: (hints[x.name], x.default is not unset or x.default_factory is not unset) for x in fields}
    return {key: (hints[key], key in kind._field_defaults) for key in kind._fields}


def read_json(path: str | Path, what: str) -> Any:
    """Read a JSON file.

    Args:
        path: the file.
        what: the expected content, for error messages.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: when the file is not JSON. NaN and infinity are not JSON.
    """

    def refuse(number: str) -> None:
        raise ValueError(f"{number} is not a number of JSON")

    try:
        return json.loads(Path(path).read_text(encoding="utf-8"), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"'{path}' is not {what}: {error}") from error


def read_rows(path: str | Path) -> list[dict[str, str]]:
    """Read a CSV file with a header.

    Args:
        path: the file.

    Returns:
        The rows, at least one.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: when the file is not CSV, has no rows, or has a row with more cells than the header.
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
    """Convert a column of a CSV file to numbers.

    Args:
        path: the file, for error messages.
        rows: rows of :func:`read_rows`.
        column: name of the column.
        read: converts the text of a cell to a number.
        gaps: allow cells that are empty or not finite. Their value is NaN.

    Raises:
        ValueError: when there is no such column, or a cell is not a number.
    """
    if column not in rows[0]:
        raise ValueError(f"'{path}' has no column '{column}'.")
    values = []
    for number, row in enumerate(rows, 1):
        cell = row[column]
        try:
            value = math.nan if gaps and not cell else read(cell)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"'{path}': '{column}' of row {number} is {cell!r}.") from error
        if not -math.inf < value < math.inf:
            if not gaps:
                raise ValueError(f"'{path}': '{column}' of row {number} is {cell!r}.")
            value = math.nan
        values.append(value)
    return values
