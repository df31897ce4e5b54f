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
        align: one letter for each column, ``l`` (left) or ``r`` (right). When ``None``, the first column is aligned to
            the left and the others to the right.
        pad: fill the cells with spaces so that the columns also line up as plain text, for a terminal.

    Returns:
        The lines of the table, without a line break at the end.

    Raises:
        ValueError: when a row, or ``align``, has another number of columns than the header.

    Example:
        >>> print(markdown_table(["solver", "µs"], [["epnp", "7"], ["p3p-ransac", "120"]], pad=True))
        | solver     |  µs |
        |------------|----:|
        | epnp       |   7 |
        | p3p-ransac | 120 |
        >>> print(markdown_table(["a", "b"], [["1", "2"]], align="ll"))
        | a | b |
        |---|---|
        | 1 | 2 |
    """
    align = "l" + "r" * (len(header) - 1) if align is None else align
    lines = [list(header), *map(list, rows)]
    for line in (align, *lines):
        if len(line) != len(header):
            raise ValueError(f"The table has {len(header)} columns, but {line!r} has {len(line)}.")
    widths = [max(2, *map(len, column)) if pad else 0 for column in zip(*lines, strict=True)]
    columns = list(zip(align, widths, strict=True))
    rule = "|".join({"l": "---", "r": "---:"}[side].rjust(width + 2, "-") for side, width in columns)
    texts = []
    for line in lines:
        cells = zip(line, columns, strict=True)
        padded = (cell.rjust(width) if side == "r" else cell.ljust(width) for cell, (side, width) in cells)
        texts.append(f"| {' | '.join(padded)} |")
    return "\n".join([texts[0], f"|{rule}|", *texts[1:]])
