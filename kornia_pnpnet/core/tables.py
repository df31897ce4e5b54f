"""Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

__all__ = ["markdown_table"]


def markdown_table(
    header: Sequence[str], rows: Iterable[Sequence[str]], *, align: str | None = None, pad: bool = False
) -> str:
    """Write a Markdown table.

    Args:
        header: titles of the columns.
        rows: cells of each row, one for each column.
        align: one letter for each column, ``l`` (left) or ``r`` (right); ``None``: only the first one to the left.
        pad: fill the cells with spaces so that the columns also line up as plain text, for a terminal.

    Example:
        >>> print(markdown_table(["solver", "µs"], [["epnp", "7"], ["p3p-ransac", "120"]], pad=True))
        | solver     |  µs |
        |------------|----:|
        | epnp       |   7 |
        | p3p-ransac | 120 |
    """
    align = align or "l" + "r" * (len(header) - 1)
    lines = [list(header), *map(list, rows)]
    widths = [max(2, *map(len, column)) if pad else 0 for column in zip(*lines, strict=True)]
    sides = [str.rjust if side == "r" else str.ljust for side in align]
    texts = [
        f"| {' | '.join(side(cell, width) for cell, side, width in zip(line, sides, widths, strict=True))} |"
        for line in lines
    ]
    ends = zip(("---:" if side == "r" else "---" for side in align), widths, strict=True)
    rule = "|".join(end.rjust(width + 2, "-") for end, width in ends)
    return "\n".join([texts[0], f"|{rule}|", *texts[1:]])
