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
        align: one letter for each column, ``l`` (left) or ``r`` (right). When ``None``, only the first column is
            aligned to the left.
        pad: fill the cells with spaces so that the columns also line up as plain text, for a terminal.

    Example:
        >>> print(markdown_table(["solver", "µs"], [["epnp", "7"], ["p3p-ransac", "120"]], pad=True))
        | solver     |  µs |
        |------------|----:|
        | epnp       |   7 |
        | p3p-ransac | 120 |
    """
    align = "l" + "r" * (len(header) - 1) if align is None else align
    lines = [list(header), *map(list, rows)]
    widths = [max(2, *map(len, column)) if pad else 0 for column in zip(*lines, strict=True)]
    rules = [
        ("---:" if side == "r" else "---").rjust(width + 2, "-") for side, width in zip(align, widths, strict=True)
    ]
    texts = []
    for line in lines:
        cells = zip(line, align, widths, strict=True)
        padded = (cell.rjust(width) if side == "r" else cell.ljust(width) for cell, side, width in cells)
        texts.append(f"| {' | '.join(padded)} |")
    return "\n".join([texts[0], f"|{'|'.join(rules)}|", *texts[1:]])
