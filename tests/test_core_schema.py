"""Data against types: what fits is built, and an error names the first entry that does not fit."""

import json
import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple, NotRequired, TypedDict

import pytest

from kornia_pnpnet.core.schema import Count, Positive, Share, from_json, read_json, to_json


class Rate(NamedTuple):
    rate: Share
    total: Count = 0


class Config(TypedDict):
    n: Count
    unit: NotRequired[str]


@dataclass(frozen=True)
class Record:
    name: str
    config: Config
    rates: dict[str, Rate]
    numbers: list[float | None]
    seconds: Positive = 1.0
    lists: dict[str, list[int]] = field(default_factory=dict)
    flag: bool | None = None
    free: Any = None
    origin: "Record | None" = None


GOOD = {"name": "a", "config": {"n": 3, "more": 1}, "rates": {"x": {"rate": 1, "old": 2}}, "numbers": [1, None, 2.5]}


def test_data_becomes_its_type_and_back():
    record = from_json(Record, {**GOOD, "origin": GOOD, "flag": True, "unknown": 5})
    assert record.rates == {"x": Rate(1)}
    assert record.config == {"n": 3, "more": 1}  # a TypedDict keeps what it does not name
    assert record.origin.name == "a"
    assert from_json(Record, json.loads(json.dumps(to_json(record)))) == record


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("name", 1),
        ("config", []),
        ("config.n", -1),
        ("config.n", True),
        ("config.n", 2**63),
        ("config.unit", None),
        ("rates", [1]),
        ("rates.x.rate", 1.5),
        ("rates.x.rate", math.nan),
        ("rates.x.total", 0.5),
        ("numbers", {}),
        ("numbers[2]", math.inf),
        ("numbers[1]", 10**400),
        ("seconds", 0),
        ("lists.a[0]", "1"),
        ("flag", 1),
        ("origin.config.n", None),
    ],
)
def test_an_error_names_the_wrong_entry(place, value):
    data = json.loads(json.dumps({**GOOD, "lists": {"a": [1]}, "origin": GOOD}))
    *path, last = place.replace("[", ".[").split(".")
    entry = data
    for key in path:
        entry = entry[key]
    entry[int(last.strip("[]")) if last.startswith("[") else last] = value
    with pytest.raises(ValueError) as caught:  # noqa: PT011  the place is the message's beginning
        from_json(Record, data, "data")
    assert str(caught.value).startswith(f"data.{place} is ")


def test_an_error_names_the_missing_entry():
    with pytest.raises(ValueError, match=r"^rates\.x\.rate is missing"):
        from_json(Record, {**GOOD, "rates": {"x": {}}})


@pytest.mark.parametrize("text", ["{", '{"a": NaN}', "[Infinity]", "\udcff"])
def test_what_is_not_json_is_refused(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ValueError, match="is not a list"):
        read_json(path, "a list")
