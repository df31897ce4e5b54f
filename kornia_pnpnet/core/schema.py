"""Reading and checking of JSON files by pydantic, which only the extras install."""

from __future__ import annotations

import dataclasses
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, ValidatorFunctionWrapHandler, WrapValidator

_T = TypeVar("_T")

#: A number in [0, 1].
Share = Annotated[float, Field(ge=0, le=1)]
#: A finite number above 0.
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
#: An integer of at least 0 that fits into 64 bits.
Count = Annotated[int, Field(ge=0, lt=2**63)]
#: Configuration of a pydantic type: types are checked strictly. Numbers, also in nested types, must be finite.
STRICT = ConfigDict(strict=True, allow_inf_nan=False)


def _keep(data: Any, check: ValidatorFunctionWrapHandler) -> Any:
    check(data)
    return data


#: Checks the keys that a ``TypedDict`` declares, and returns the mapping unchanged, with all undeclared keys.
Kept = WrapValidator(_keep)


def read_json(path: str | Path, kind: type[_T], what: str) -> _T:
    """Read a JSON file, and check its content against a type that pydantic supports.

    Invalid content raises ``ValueError``. The message contains ``what`` (the expected content) and the first error:
    "'a.json' is not a results file: rows[0].success.rate is missing".
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
    """Convert nested dataclasses and named tuples to dictionaries, and other tuples to lists."""
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {key: to_json(entry) for key, entry in value.items()}
    return [to_json(entry) for entry in value] if isinstance(value, (list, tuple)) else value
