"""The page on real matches and the overview of the home page, from what ``benchmarks/real_matches.py`` wrote."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import pandas as pd
import torch
from figures import find_rows
from measure import ANY, HERE
from short_runs import read_summary

from kornia_pnpnet.core.tables import markdown_table
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


def best_peer(pooled: Mapping[str, Mapping[str, Pooled]], kind: str = "all") -> str:
    """The PoseLib with the highest success."""
    peers = [name for name in pooled if name.startswith("PoseLib")]
    return max(peers, key=lambda name: pooled[name][kind].success.rate)


def overview(files: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Facts of the overview on the home page and in the README: the solvers on the real matches of all files."""
    pooled = pool(files)
    measured = json.loads((HERE / f"{SINGLE}.json").read_text(encoding="utf-8"))
    single, batched = (pool([of_batch(measured, size)]) for size in (1, BATCH))
    kinds = [kind for kind in pooled[f"`{ANY}`"] if kind != "all"]
    ours = [f"`{ANY}`", f"`{ANY}`, {SCORES}"]
    others = [name for name in pooled if name[0] != "`" and name != _TITLES["known-inliers"]]
    best = [best_peer({x: pooled[x] for x in pooled if x.endswith(SCORES) == scores}) for scores in (False, True)]
    shown = [name for name in others if not name.startswith("PoseLib") or name in best]
    rows = [*ours, *sorted(shown, key=lambda name: -pooled[name]["all"].success.rate)]
    lines = []
    for name in rows:
        title_, mark = name.replace(f", {SCORES}", f" with {SCORES}"), "**" if name in ours else ""
        cells = [title_, f"{BATCH}" if name in ours else "1"]
        for kind in kinds:
            cells += [f"{100 * pooled[name][kind].success.rate:.1f} %", microseconds(pooled[name][kind])]
        lines.append([f"{mark}{cell}{mark}" for cell in cells])
        if name in ours:
            lines.append([title_, "1"])
            for kind in kinds:
                one, many = single[name][kind], batched[name][kind]
                same = one.success.rate == many.success.rate
                lines[-1] += ["same" if same else f"{100 * one.success.rate:.1f} %\\*", f"{microseconds(one)}\\*"]
    short = {"ratio test": "filtered", "no ratio test": "raw"}
    header = ["Solver", "images per call", *(x for kind in kinds for x in (f"{short[kind]}: right", "µs per image"))]
    rates = [pooled[name][kind].success for name in rows for kind in kinds]
    ahead = []
    for kind in kinds:
        base, alone = pooled[ours[0]][kind], single[ours[0]][kind]
        better = {
            "more often right": [x for x in shown if pooled[x][kind].success.rate > base.success.rate],
            "faster": [x for x in shown if pooled[x][kind].ms < base.ms],
            "faster with one image per call": [x for x in shown if single[x][kind].ms < alone.ms],
        }
        for what, found in better.items():
            names = dict.fromkeys(name.partition(",")[0] for name in found)
            ahead += [f"{' and '.join(names)} {what} on {short[kind]} matches"] if names else []
    there = ((f"`{ANY}` in batches of {BATCH}", batched[ours[0]]), (best[0], single[best[0]]))
    return {
        "table": markdown_table(header, lines),
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


def of_batch(results: Mapping[str, Any], size: int) -> dict[str, Any]:
    """The file with the rows of one number of problems in a call."""
    return {**results, "rows": [row for row in results["rows"] if row["batch"] == size]}


def points_ahead(pooled: Mapping[str, Mapping[str, Pooled]], ours: str = f"`{ANY}`") -> float:
    """Difference of the success of one of our solvers and of the best PoseLib."""
    return pooled[ours]["all"].success.rate - pooled[best_peer(pooled)]["all"].success.rate


def percent(value: float | None) -> str:
    """A share in per cent, without the sign."""
    return "–" if value is None else f"{100 * value:.1f}"


def group_table(results: Mapping[str, Any], kind: str) -> str:
    """Success by share of outliers of one kind of matches, time, and the share of ``ok``."""
    settings, found = results["settings"], find_rows(results, kind)
    groups = ["all", *(f"{100 * a:.0f}–{100 * b:.0f} %" for a, b in pairwise(settings["shares"]))]
    counts = [found[settings["solvers"][0]][group]["count"] for group in groups]
    header = [f"{kind}: right (%)", "ms", *(f"{g} ({n})" for g, n in zip(groups, counts, strict=True))]
    lines = []
    for name, one in found.items():
        every = one["all"]
        ok = [percent(every[key]) for key in ("ok_of_right", "ok_of_far")]
        shares = [percent(one[group]["success"]) for group in groups]
        lines.append([title(name, settings), f"{every['ms_per_problem']:.2f}", *shares, *ok])
    return markdown_table([*header, "ok of right", "ok of far off"], lines)


def facts(results: Mapping[str, Any]) -> dict[str, Any]:
    """Tables of one file of ``benchmarks/real_matches.py measure``, its number of problems, and the file."""
    kinds = list(dict.fromkeys(row["kind"] for row in results["rows"]))
    known = {row["scene"]: row for row in read_summary(HERE / "real_matches_scenes.csv")}
    lines = []
    for entry in results["counts"]:
        about = known.get(entry["scene"], {})
        numbers = [str(entry[kind]["counted"]) for kind in kinds]
        lines.append([entry["scene"], *(about.get(key, "–") for key in ("shows", "source", "licence")), *numbers])
    header = ["Scene", "shows", "public repository", "licence", *(f"problems, {kind}" for kind in kinds)]
    return {
        "tables": {kind: group_table(results, kind) for kind in kinds},
        "scenes": markdown_table(header, lines, align="llll" + "r" * len(kinds)),
        "total": sum(entry[kind]["counted"] for entry in results["counts"] for kind in kinds),
        "results": results,
    }


def pooled_table(files: Sequence[Mapping[str, Any]]) -> str:
    """All solvers that every file has, both kinds, beside the best PoseLib."""
    pooled = pool(files)
    peer = best_peer(pooled)
    kinds = [kind for kind in pooled[peer] if kind != "all"]
    lines = []
    for name, one in sorted(pooled.items(), key=lambda item: -item[1]["all"].success.rate):
        rates = [f"{100 * one[kind].success.rate:.1f}" for kind in (*kinds, "all")]
        times = [f"{one[kind].ms:.2f}" for kind in kinds]
        lines.append([name, *rates, *times, f"{one['all'].ms / pooled[peer]['all'].ms:.2f}"])
    header = ["Right (%)", *kinds, "both", *(f"ms, {kind}" for kind in kinds), f"time / {peer}"]
    return markdown_table(header, lines)


def measurements_table(files: Iterable[Mapping[str, Any]]) -> str:
    """A line for each file: how far ``pnpnet-set`` is ahead of the PoseLib that is best on its problems."""
    lines = []
    for results in files:
        pooled = pool([results])
        peer = best_peer(pooled)
        base = pooled[peer]["all"]
        cells = [f"{100 * points_ahead(pooled, name):+.1f}" for name in (f"`{ANY}`", f"`{ANY}`, {SCORES}")]
        ratio = pooled[f"`{ANY}`"]["all"].ms / base.ms
        date, scenes = results["environment"]["date"][:10], len(results["counts"])
        lines.append([date, f"{scenes}", f"{base.success.total}", peer, *cells, f"{ratio:.2f}"])
    header = ["Measured", "scenes", "problems", "best PoseLib", f"`{ANY}` ahead (points)", "with scores", "time ratio"]
    return markdown_table(header, lines, align="lrrlrrr")


def page_facts(
    files: Sequence[Mapping[str, Any]], costs: Mapping[str, Any], keypoints: Mapping[str, Any]
) -> dict[str, Any]:
    """Facts for the template of the page on real matches.

    ``files`` are the files of :data:`MATCHES`; ``benchmarks/real_matches.py cost`` wrote ``costs``.
    """
    first = files[0]
    solver = first["settings"]["solvers"][0]
    curve = first["reliability"][solver]
    deciles = [
        [f"{i / 10:.1f} to {(i + 1) / 10:.1f}", f"{count:.0f}", percent(predicted), percent(observed)]
        for i, (count, predicted, observed) in enumerate(
            zip(*(curve[key] for key in ("number", "predicted", "observed")), strict=True)
        )
        if count
    ]
    kinds = list(dict.fromkeys(row["kind"] for row in first["rows"]))
    raw = find_rows(first, kinds[1])[solver]["all"]
    return {
        "first": first,
        "solver": title(solver, first["settings"]).replace(f", {SCORES}", f" with {SCORES}"),
        "raw": raw,
        "far_count": round(raw["far"] * raw["count"]),
        "costs": costs,
        "pooled": pooled_table(files),
        "measurements": measurements_table(files),
        "total": sum(facts(results)["total"] for results in files),
        "scene_count": sum(len(results["counts"]) for results in files),
        "files": [{"name": name, **facts(results)} for name, results in zip(MATCHES, files, strict=True)],
        "deciles": markdown_table(["predicted", "problems", "predicted mean (%)", "not far off (%)"], deciles),
        "keypoints": keypoint_tables(keypoints),
    }


# Ways to use confidences that the page compares pairwise, the first minus the second.
_WAYS = (("confidence=c", "weights=c**6"), ("confidence=c", "nothing"))


def keypoint_tables(found: Mapping[str, Any]) -> dict[str, Any]:
    """Tables of what ``benchmarks/keypoints.py`` wrote: errors, paired differences, sources of the keypoints."""
    results = found["results"]
    names = [one["source"] for one in results]
    by_way = [{row["way"]: row for row in one["rows"]} for one in results]
    errors = [
        [f"`{way}`", *(f"{r[way]['error']:.3f}, {100 * r[way]['right']:.1f}, {100 * r[way]['ok']:.0f}" for r in by_way)]
        for way in by_way[0]
    ]
    differences = [
        [name, *("{:+.4f} ({:+.4f} to {:+.4f})".format(*r[way]["less"][base]["capped"]) for way, base in _WAYS)]
        for name, r in zip(names, by_way, strict=True)
    ]
    sources = []
    for one in results:
        source = found["sources"][one["source"]]
        numbers = [str(one["measured"]), f"{one['pairs']:.0f}", f"{100 * one['inliers']:.0f}"]
        sources.append([one["source"], *numbers, f"{source['repository']}: {source['what']}. Seen: {source['seen']}"])
    header = ("error, at most 0.5", *(f"`{way}` less `{base}`" for way, base in _WAYS))
    return {
        "errors": markdown_table(("pnpnet-set with", *names), errors),
        "differences": markdown_table(header, differences),
        "sources": markdown_table(("keypoints", "problems", "pairs", "inliers (%)", "source"), sources, align="lrrrl"),
        "right": found["settings"]["right"],
    }
