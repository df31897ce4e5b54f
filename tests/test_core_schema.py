"""Data against types: what fits is built, and an error names the file and the first entry that does not fit."""

import json
import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

import pytest
from typing_extensions import TypedDict

from kornia_pnpnet.core.schema import STRICT, Count, Kept, Positive, Share, read_json, to_json


class Rate(NamedTuple):
    rate: Share
    total: Count = 0


class Config(TypedDict):
    n: Count


@dataclass(frozen=True)
class Record:
    __pydantic_config__: ClassVar = STRICT

    config: Annotated[Config, Kept]
    rates: dict[str, Rate]
    numbers: list[float | None]
    seconds: Positive = 1.0
    origin: "Record | None" = None


GOOD = {"config": {"more": 1, "n": 3}, "rates": {"x": {"rate": 1}}, "numbers": [1, None, 2.5], "unknown": 5}


def read(folder, data):
    path = folder / "a.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return read_json(path, Record, "a record")


def test_data_becomes_its_type_and_back(tmp_path):
    record = read(tmp_path, {**GOOD, "origin": GOOD})
    assert record.rates == {"x": Rate(1)}
    assert list(record.config.items()) == [("more", 1), ("n", 3)]
    assert record.origin.numbers == [1, None, 2.5]
    assert read(tmp_path, to_json(record)) == record


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("config", []),
        ("config.n", -1),
        ("config.n", 2**63),
        ("rates.x.rate", math.nan),
        ("rates.x.total", 0.5),
        ("numbers[1]", 10**400),
        ("seconds", "1"),
        ("origin.config.n", None),
    ],
)
def test_an_error_names_the_wrong_entry(place, value, tmp_path):
    data = json.loads(json.dumps({**GOOD, "origin": GOOD}))
    *path, last = place.replace("[", ".[").split(".")
    entry = data
    for key in path:
        entry = entry[key]
    entry[int(last.strip("[]")) if last.startswith("[") else last] = value
    with pytest.raises(ValueError, match=r"a\.json' is not a record: ") as caught:
        read(tmp_path, data)
    assert f": {place} is " in str(caught.value)


@pytest.mark.parametrize(
    ("data", "message"),
    [("{", "Invalid JSON"), ("[" * 9999, "Invalid JSON"), ({**GOOD, "rates": {"x": {}}}, r"rates\.x\.rate is missing")],
)
def test_what_is_no_json_or_incomplete_is_refused(tmp_path, data, message):
    with pytest.raises(ValueError, match=rf"a\.json' is not a record: {message}"):
        read(tmp_path, data)
