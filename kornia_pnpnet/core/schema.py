"""Reading data that anyone may have written, with an error that names the wrong entry: JSON by key, CSV by column."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import reprlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
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

__all__ = [
    "RATE",
    "Count",
    "Positive",
    "Rule",
    "Share",
    "from_json",
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
    "to_json",
]

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
