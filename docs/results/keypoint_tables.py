"""Tables of ``keypoints.json`` for the page on real matches."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from kornia_pnpnet.core.tables import markdown_table

__all__ = ["keypoint_tables"]

# Ways that the page compares pairwise, the first minus the second.
_PAIRS = (("confidence=c", "weights=c**6"), ("confidence=c", "nothing"))


def keypoint_tables(found: Mapping[str, Any]) -> dict[str, Any]:
    """Tables and facts of what ``benchmarks/keypoints.py`` wrote.

    Args:
        found: the results.

    Returns:
        ``errors``: error and share of right poses by way and source; ``differences``: paired differences of the error
        with their intervals; ``sources``: where the keypoints are from.
    """
    results = found["results"]
    ways = [row["way"] for row in results[0]["rows"]]
    by_way = [{row["way"]: row for row in one["rows"]} for one in results]
    cells = [[f"{r[w]['error']:.3f}, {100 * r[w]['right']:.1f}, {100 * r[w]['ok']:.0f}" for r in by_way] for w in ways]
    errors = [[f"`{way}`", *row] for way, row in zip(ways, cells, strict=True)]
    differences = [
        [
            one["source"],
            *("{:+.4f} ({:+.4f} to {:+.4f})".format(*r[way]["less"][base]["capped"]) for way, base in _PAIRS),
        ]
        for one, r in zip(results, by_way, strict=True)
    ]
    names = [one["source"] for one in results]
    sources = [
        [one["source"], str(one["measured"]), f"{one['pairs']:.0f}", f"{100 * one['inliers']:.0f}", _source(found, one)]
        for one in results
    ]
    return {
        "errors": markdown_table(("pnpnet-set with", *names), errors),
        "differences": markdown_table(
            ("error, at most 0.5", *(f"`{way}` less `{base}`" for way, base in _PAIRS)), differences
        ),
        "sources": markdown_table(("keypoints", "problems", "pairs", "inliers (%)", "source"), sources, align="lrrrl"),
        "right": found["settings"]["right"],
    }


def _source(found: Mapping[str, Any], one: Mapping[str, Any]) -> str:
    """Where the keypoints of a result are from, and what was seen of them."""
    source = found["sources"][one["source"]]
    return f"{source['repository']}: {source['what']}. Seen: {source['seen']}"
