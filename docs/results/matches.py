"""The page on real matches and the overview of the home page, from what ``benchmarks/real_matches.py`` wrote."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import pandas as pd
import torch
from figures import find_rows
from measure import ANY, HERE
from rates import read_summary

from kornia_pnpnet.metrics import SuccessRate, success_rate

#: Files of ``benchmarks/real_matches.py measure``, each on scenes that no solver had seen, the latest last.
MATCHES = ("real_matches", "real_matches_again", "real_matches_third", "real_matches_fourth")
#: The file of ``benchmarks/real_matches.py measure --batch 1`` on some of these scenes: one image in each call.
SINGLE = "real_matches_single"
BATCH = 500  # problems in a call of ours in the files of MATCHES
SCORES = "scores"  # end of the title of a solver that got a score for each pair
_TITLES = {"poselib": "PoseLib", "opencv-usac": "OpenCV USAC", "known-inliers": "inliers known"}
_KNOWN = {"": "", "ratio": SCORES, "sigma": "noise known"}


def title(solver: str, settings: Mapping[str, Any]) -> str:
    """The name of a solver for tables.

    The first file was measured when the fixed effort was the default of ``pnpnet-set``: it names the adaptive one.
    """
    spec, _, known = solver.partition("+")
    name, _, options = spec.partition(":")
    parts = [_TITLES.get(name, name if name == "pycolmap" else f"`{name}`")]
    if name == ANY:
        fixed_by_default = any("effort=adaptive" in other for other in settings["solvers"])
        fixed = "effort=fixed" in options or (fixed_by_default and not options)
        parts += ["fixed effort"] if fixed else []
    parts += [f"{pixels} px" for pixels in re.findall(r"threshold=(\d+)", options)]
    return ", ".join(filter(None, (*parts, _KNOWN[known])))


class Pooled(NamedTuple):
    """One solver on the problems of one kind of several files: success, and milliseconds per problem."""

    success: SuccessRate
    ms: float


def pool(files: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Pooled]]:
    """The solvers that all files have, by title and kind of matches; over both kinds together as ``all``."""
    rows = pd.concat([pd.DataFrame(one["rows"]).assign(file=i) for i, one in enumerate(files)], ignore_index=True)
    rows = rows[rows.group == "all"]
    names = [title(solver, files[i]["settings"]) for solver, i in zip(rows.solver, rows.file, strict=True)]
    rows = rows.assign(name=names, right=rows["count"] * rows.success, ms=rows["count"] * rows.ms_per_problem)
    found: dict[str, dict[str, Pooled]] = {}
    for name, one in rows.groupby("name", sort=False):
        if one.file.nunique() == len(files):
            kinds = [*one.groupby("kind", sort=False), ("all", one)]
            sums = {kind: part[["count", "right", "ms"]].sum() for kind, part in kinds}
            found[str(name)] = {
                str(kind): Pooled(success_rate(torch.arange(int(x["count"])) < round(x.right)), x.ms / x["count"])
                for kind, x in sums.items()
            }
    return found


def best_peer(pooled: Mapping[str, Mapping[str, Pooled]]) -> str:
    """The PoseLib with the highest success."""
    peers = [name for name in pooled if name.startswith("PoseLib")]
    return max(peers, key=lambda name: pooled[name]["all"].success.rate)


def overview(files: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Facts of the overview on the home page and in the README: the solvers on the real matches of all files."""
    pooled = pool(files)
    measured = json.loads((HERE / f"{SINGLE}.json").read_text(encoding="utf-8"))
    by_size = [[row for row in measured["rows"] if row["batch"] == size] for size in (1, BATCH)]
    single, batched = (pool([{**measured, "rows": rows}]) for rows in by_size)
    kinds = [kind for kind in pooled[f"`{ANY}`"] if kind != "all"]
    ours = [f"`{ANY}`", f"`{ANY}`, {SCORES}"]
    others = [name for name in pooled if name[0] != "`" and name != _TITLES["known-inliers"]]
    best = [best_peer({x: pooled[x] for x in pooled if x.endswith(SCORES) == scores}) for scores in (False, True)]
    shown = [name for name in others if not name.startswith("PoseLib") or name in best]
    rows = [*ours, *sorted(shown, key=lambda name: -pooled[name]["all"].success.rate)]
    short = {"ratio test": "filtered", "no ratio test": "raw"}
    rates = [pooled[name][kind].success for name in rows for kind in kinds]
    ahead = {}
    for kind in kinds:
        base, alone = pooled[ours[0]][kind], single[ours[0]][kind]
        better = {
            "more solved": [x for x in shown if pooled[x][kind].success.rate > base.success.rate],
            "faster than its batches": [x for x in shown if pooled[x][kind].ms < base.ms],
            "faster than its single calls": [x for x in shown if single[x][kind].ms < alone.ms],
        }
        names = {what: dict.fromkeys(name.partition(",")[0] for name in found) for what, found in better.items()}
        ahead[short[kind]] = "; ".join(f"{what}: {', '.join(who)}" for what, who in names.items() if who) or "nobody"
    there = ((f"`{ANY}` in batches", batched[ours[0]]), (best[0], single[best[0]]))
    return {
        **{"rows": rows, "ours": ours, "kinds": kinds, "short": short, "scores": SCORES, "batch": BATCH},
        **{"pooled": pooled, "single": single, "batched": batched, "microseconds": microseconds},
        "total": pooled[ours[0]]["all"].success.total,
        "scenes": sum(len(results["counts"]) for results in files),
        "right": files[0]["settings"]["right"],
        "reach": 100 * max(max(x.rate - x.low, x.high - x.rate) for x in rates),
        "cpu": files[0]["environment"]["cpu"],
        "few": single[ours[0]]["all"].success.total,
        "there": {name: [microseconds(one[kind]) for kind in kinds] for name, one in there},
        "there_cpu": measured["environment"]["cpu"],
        "ahead": ahead,
        "steps": [100 * points_ahead(pool([results])) for results in files],
        "any": ANY,
    }


def microseconds(one: Pooled) -> str:
    """The time of an image for a table."""
    return f"{1e3 * one.ms:.0f}"


def points_ahead(pooled: Mapping[str, Mapping[str, Pooled]], ours: str = f"`{ANY}`") -> float:
    """Difference of the success of one of our solvers and of the best PoseLib."""
    return pooled[ours]["all"].success.rate - pooled[best_peer(pooled)]["all"].success.rate


def page_facts(
    files: Sequence[Mapping[str, Any]], costs: Mapping[str, Any], keypoints: Mapping[str, Any]
) -> dict[str, Any]:
    """Facts for the template of the page on real matches.

    ``files`` are the files of :data:`MATCHES`; ``benchmarks/real_matches.py`` wrote ``costs`` with ``cost``, and
    ``benchmarks/keypoints.py`` wrote ``keypoints``.
    """
    first, pooled = files[0], pool(files)
    solver = first["settings"]["solvers"][0]
    kinds = list(dict.fromkeys(row["kind"] for row in first["rows"]))
    return {
        "first": first,
        "solver": title(solver, first["settings"]).replace(f", {SCORES}", f" with {SCORES}"),
        "raw": find_rows(first, kinds[1])[solver]["all"],
        "costs": costs,
        "kinds": kinds,
        "pooled": dict(sorted(pooled.items(), key=lambda item: -item[1]["all"].success.rate)),
        "peer": best_peer(pooled),
        "files": [facts(name, results, kinds) for name, results in zip(MATCHES, files, strict=True)],
        "scenes": {row["scene"]: row for row in read_summary(HERE / "real_matches_scenes.csv")},
        "reliability": first["reliability"][solver],
        "keypoints": keypoints,
        "ways": [{row["way"]: row for row in one["rows"]} for one in keypoints["results"]],
        **{"any": f"`{ANY}`", "scores": SCORES, "points_ahead": points_ahead, "title": title},
    }


def facts(name: str, results: Mapping[str, Any], kinds: Iterable[str]) -> dict[str, Any]:
    """Facts of one file of ``measure``: its best PoseLib, and its rows by kind and solver."""
    pooled = pool([results])
    shares = ["all", *(f"{100 * a:.0f}–{100 * b:.0f} %" for a, b in pairwise(results["settings"]["shares"]))]
    total = sum(entry[kind]["counted"] for entry in results["counts"] for kind in kinds)
    tables = {kind: find_rows(results, kind) for kind in kinds}
    found = {"name": name, "results": results, "pooled": pooled, "peer": best_peer(pooled)}
    return {**found, "groups": shares, "tables": tables, "total": total}
