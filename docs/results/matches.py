"""The page on real matches and the overview of the home page, from what ``benchmarks/real_matches.py`` wrote."""

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import pandas as pd
import torch
from figures import find_rows
from measure import ANY, HERE

from kornia_pnpnet.core.files import read_csv
from kornia_pnpnet.metrics import SuccessRate, success_rate

#: Files of ``benchmarks/real_matches.py measure``: scenes that no solver had seen, and scenes that we had looked at, on
#: which the options of other libraries were chosen.
UNSEEN, SEEN = "real_matches", "real_matches_seen"
BATCH = 500  # problems in a call of ours
SCORES = "scores"  # end of the title of a solver that got a score for each pair
WITH_SCORES = f"{ANY}+ratio"
_TITLES = {"poselib": "PoseLib", "opencv-usac": "OpenCV USAC", "known-inliers": "inliers known"}


def title(solver: str) -> str:
    """The name of a solver for tables."""
    spec, _, known = solver.partition("+")
    name, _, options = spec.partition(":")
    parts = [_TITLES.get(name, name if name == "pycolmap" else f"`{name}`")]
    parts += ["fixed effort"] if "effort=fixed" in options else []
    parts += [f"{pixels} px" for pixels in re.findall(r"threshold=(\d+)", options)]
    parts += ["few samples"] if "max_iterations=10000," in f"{options}," else []
    return ", ".join(filter(None, (*parts, SCORES if known else "")))


class Total(NamedTuple):
    """One solver on the problems of one kind: success, and milliseconds per problem."""

    success: SuccessRate
    ms: float


def at_size(results: Mapping[str, Any], size: int = BATCH) -> dict[str, Any]:
    """A file with the rows of one number of problems in a call of ours."""
    return {**results, "rows": [row for row in results["rows"] if row["batch"] == size]}


def totals(results: Mapping[str, Any]) -> dict[str, dict[str, Total]]:
    """The solvers of a file, by name and kind of matches; over both kinds together as ``all``."""
    rows = pd.DataFrame([row for row in results["rows"] if row["group"] == "all"])
    rows = rows.assign(right=rows["count"] * rows.success, ms=rows["count"] * rows.ms_per_problem)
    found: dict[str, dict[str, Total]] = {}
    for name, one in rows.groupby("solver", sort=False):
        kinds = [*one.groupby("kind", sort=False), ("all", one)]
        sums = {kind: part[["count", "right", "ms"]].sum() for kind, part in kinds}
        found[str(name)] = {
            str(kind): Total(success_rate(torch.arange(int(x["count"])) < round(x.right)), x.ms / x["count"])
            for kind, x in sums.items()
        }
    return found


def best_peer(found: Mapping[str, Mapping[str, Total]]) -> str:
    """The PoseLib with the highest success."""
    peers = [name for name in found if name.startswith("poselib")]
    return max(peers, key=lambda name: found[name]["all"].success.rate)


def points_ahead(found: Mapping[str, Mapping[str, Total]], ours: str = ANY) -> float:
    """Percentage points by which one of our solvers has more success than the best PoseLib."""
    return 100.0 * (found[ours]["all"].success.rate - found[best_peer(found)]["all"].success.rate)


def overview(unseen: Mapping[str, Any], seen: Mapping[str, Any]) -> dict[str, Any]:
    """Facts of the overview on the home page and in the README: the solvers on real matches."""
    batched, single = (totals(at_size(unseen, size)) for size in (BATCH, 1))
    kinds = [kind for kind in batched[ANY] if kind != "all"]
    short = dict(zip(kinds, ("filtered", "raw"), strict=True))
    ours = [ANY, WITH_SCORES]
    others = [name for name in batched if title(name)[0] != "`" and title(name) != _TITLES["known-inliers"]]
    others.sort(key=lambda name: -batched[name]["all"].success.rate)
    rates = [batched[name][kind].success for name in (*ours, *others) for kind in kinds]
    ahead = {}
    for kind in kinds:
        base, alone = batched[ANY][kind], single[ANY][kind]
        better = {
            "more solved": [x for x in others if batched[x][kind].success.rate > base.success.rate],
            "faster than its batches": [x for x in others if batched[x][kind].ms < base.ms],
            "faster than its single calls": [x for x in others if single[x][kind].ms < alone.ms],
        }
        names = {what: dict.fromkeys(title(name).partition(",")[0] for name in who) for what, who in better.items()}
        ahead[short[kind]] = "; ".join(f"{what}: {', '.join(who)}" for what, who in names.items() if who) or "nobody"
    known = totals(at_size(seen))
    return {
        **{"rows": [*ours, *others], "ours": ours, "kinds": kinds, "short": short, "scores": SCORES, "batch": BATCH},
        **{"batched": batched, "single": single, "title": title, "any": ANY, "ahead": ahead},
        "total": batched[ANY]["all"].success.total,
        "scenes": len(unseen["counts"]),
        "right": unseen["settings"]["right"],
        "reach": 100 * max(max(x.rate - x.low, x.high - x.rate) for x in rates),
        "cpu": unseen["environment"]["cpu"],
        "lead": {"here": points_ahead(batched), "seen": points_ahead(known)},
        "seen_total": known[ANY]["all"].success.total,
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
        "raw": find_rows(first, kinds[1])[ANY]["all"],
        "totals": dict(sorted(found.items(), key=lambda item: -item[1]["all"].success.rate)),
        "peer": best_peer(found),
        "files": [facts(name, at_size(one), kinds) for name, one in ((UNSEEN, unseen), (SEEN, seen))],
        "scenes": {row["scene"]: row for row in read_csv(HERE / "real_matches_scenes.csv", ()).values()},
        "reliability": first["reliability"][ANY],
        "keypoints": keypoints,
        "ways": [{row["way"]: row for row in one["rows"]} for one in keypoints["results"]],
        **{"any": ANY, "with_scores": WITH_SCORES, "points_ahead": points_ahead, "title": title},
    }


def facts(name: str, results: Mapping[str, Any], kinds: list[str]) -> dict[str, Any]:
    """Facts of one file of ``measure``: its best PoseLib, and its rows by kind and solver."""
    found = totals(results)
    shares = ["all", *dict.fromkeys(row["group"] for row in results["rows"] if row["group"].endswith(" %"))]
    tables = {kind: find_rows(results, kind) for kind in kinds}
    more = {"groups": shares, "tables": tables, "total": found[ANY]["all"].success.total}
    return {"name": name, "results": results, "totals": found, "peer": best_peer(found), **more}
