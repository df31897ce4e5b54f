"""The page on real matches and the overview of the home page, from what ``benchmarks/real_matches.py`` wrote."""

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from figures import find_rows
from harness import interval
from measure import ANY, HERE
from numpy.typing import NDArray

from kornia_pnpnet.core.files import read_csv

#: Files of ``benchmarks/real_matches.py measure``: scenes that no solver had seen, and scenes that we had looked at, on
#: which the options of other libraries were chosen.
UNSEEN, SEEN = "real_matches", "real_matches_seen"
BATCH = 500  # problems in a call of ours
SCORES = "scores"  # end of the title of a solver that got a score for each pair
WITH_SCORES = f"{ANY}+ratio"
_TITLES = {"poselib": "PoseLib", "opencv-usac": "OpenCV USAC", "known-inliers": "inliers known", "pycolmap": "pycolmap"}


def title(solver: str) -> str:
    """The name of a solver for tables."""
    spec, _, known = solver.partition("+")
    name, _, options = spec.partition(":")
    parts = [_TITLES.get(name, f"`{name}`"), *["fixed effort"] * ("effort=fixed" in options)]
    parts += [f"{pixels} px" for pixels in re.findall(r"threshold=(\d+)", options)]
    parts += ["few samples"] if "max_iterations=10000," in f"{options}," else []
    return ", ".join(filter(None, (*parts, SCORES if known else "")))


class Total(NamedTuple):
    """One solver on the problems of one kind: share of them that is solved, their number, milliseconds for one."""

    rate: float
    number: int
    ms: float


def at_size(results: Mapping[str, Any], size: int = BATCH) -> dict[str, Any]:
    """A file with the rows of one number of problems in a call of ours."""
    return {**results, "rows": [row for row in results["rows"] if row["batch"] == size]}


def totals(results: Mapping[str, Any]) -> dict[str, dict[str, Total]]:
    """The solvers of a file, by name and kind of matches; over both kinds together as ``all``."""
    found: dict[str, dict[str, list[Any]]] = {}
    for row in (row for row in results["rows"] if row["group"] == "all"):
        for kind in (row["kind"], "all"):
            found.setdefault(row["solver"], {}).setdefault(kind, []).append(row)

    def total(rows: list[Any]) -> Total:
        number = sum(row["count"] for row in rows)
        rate, ms = (sum(row["count"] * row[key] for row in rows) / number for key in ("success", "ms_per_problem"))
        return Total(rate, number, ms)

    return {name: {kind: total(rows) for kind, rows in kinds.items()} for name, kinds in found.items()}


def by_success(found: Mapping[str, Mapping[str, Total]]) -> list[str]:
    """Other libraries, the one with the highest success first."""
    others = [name for name in found if title(name)[0] != "`" and title(name) != _TITLES["known-inliers"]]
    return sorted(others, key=lambda name: -found[name]["all"].rate)


def by_scene(results: Mapping[str, Any], solver: str, kind: str = "") -> NDArray[np.float64]:
    """Solved problems and all problems of each scene, of one kind or of both, shape (2, scenes)."""
    scenes = [entry["scene"] for entry in results["counts"]]
    sums = np.zeros((2, len(scenes)))
    for row in results["rows"]:
        if row["solver"] == solver and row["kind"] == (kind or row["kind"]) and row["group"] in scenes and row["count"]:
            sums[:, scenes.index(row["group"])] += row["count"] * row["success"], row["count"]
    return sums


def points_ahead(results: Mapping[str, Any], ours: str = ANY) -> str:
    """Percentage points by which one of our solvers has more success than the best library, and their interval."""
    (mine, number), (theirs, _) = (by_scene(results, name) for name in (ours, by_success(totals(results))[0]))
    return "{:+.1f} ({:+.1f} to {:+.1f})".format(*interval(100.0 * (mine - theirs), number))


def overview(unseen: Mapping[str, Any], seen: Mapping[str, Any]) -> dict[str, Any]:
    """Facts of the overview on the home page and in the README: the solvers on real matches."""
    unseen, alone = (at_size(unseen, size) for size in (BATCH, 1))
    batched, single = totals(unseen), totals(alone)
    kinds = [kind for kind in batched[ANY] if kind != "all"]
    short = dict(zip(kinds, ("filtered", "raw"), strict=True))
    ours = [ANY, WITH_SCORES]
    others = by_success(batched)
    rates = [interval(*by_scene(unseen, name, kind)) for name in (*ours, *others) for kind in kinds]
    ahead = {}
    for kind in kinds:
        base = batched[ANY][kind]
        better = {
            "more solved": [x for x in others if batched[x][kind].rate > base.rate],
            "faster than its batches": [x for x in others if batched[x][kind].ms < base.ms],
            "faster than its single calls": [x for x in others if single[x][kind].ms < single[ANY][kind].ms],
        }
        names = {what: dict.fromkeys(title(name).partition(",")[0] for name in who) for what, who in better.items()}
        ahead[short[kind]] = "; ".join(f"{what}: {', '.join(who)}" for what, who in names.items() if who) or "nobody"
    known = at_size(seen)
    return {
        **{"rows": [*ours, *others], "ours": ours, "kinds": kinds, "short": short, "scores": SCORES, "batch": BATCH},
        **{"batched": batched, "single": single, "title": title, "any": ANY, "ahead": ahead},
        **{"total": batched[ANY]["all"].number, "scenes": len(unseen["counts"]), "right": unseen["settings"]["right"]},
        "reach": 100 * max(max(rate - low, high - rate) for rate, low, high in rates),
        "lead": {"here": points_ahead(unseen), "seen": points_ahead(known)},
        **{"cpu": unseen["environment"]["cpu"], "seen_total": totals(known)[ANY]["all"].number},
    }


def page_facts(
    unseen: Mapping[str, Any], seen: Mapping[str, Any], costs: Mapping[str, Any], keypoints: Mapping[str, Any]
) -> dict[str, Any]:
    """Facts for the template of the page on real matches.

    ``unseen`` and ``seen`` are the files :data:`UNSEEN` and :data:`SEEN`; ``benchmarks/real_matches.py`` wrote
    ``costs`` with ``cost``, and ``benchmarks/keypoints.py`` wrote ``keypoints``.
    """
    first = at_size(unseen)
    found = totals(first)
    kinds = [kind for kind in found[ANY] if kind != "all"]
    return {
        **{"first": first, "solver": title(ANY), "kinds": kinds, "costs": costs},
        **{"raw": find_rows(first, kinds[1])[ANY]["all"], "peer": by_success(found)[0], "keypoints": keypoints},
        "totals": dict(sorted(found.items(), key=lambda item: -item[1]["all"].rate)),
        "files": [facts(name, at_size(one), kinds) for name, one in ((UNSEEN, unseen), (SEEN, seen))],
        "scenes": {row["scene"]: row for row in read_csv(HERE / "real_matches_scenes.csv", ()).values()},
        "reliability": first["reliability"][ANY],
        "ways": [{row["way"]: row for row in one["rows"]} for one in keypoints["results"]],
        **{"any": ANY, "with_scores": WITH_SCORES, "points_ahead": points_ahead, "title": title},
    }


def facts(name: str, results: Mapping[str, Any], kinds: list[str]) -> dict[str, Any]:
    """Facts of one file of ``measure``: the best other library, and its rows by kind and solver."""
    found = totals(results)
    shares = ["all", *dict.fromkeys(row["group"] for row in results["rows"] if row["group"].endswith(" %"))]
    tables = {kind: find_rows(results, kind) for kind in kinds}
    more = {"groups": shares, "tables": tables, "total": found[ANY]["all"].number}
    return {"name": name, "results": results, "totals": found, "peer": by_success(found)[0], **more}
