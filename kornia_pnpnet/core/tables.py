"""Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(
    header: Sequence[str], rows: Iterable[Sequence[str]], *, align: str | None = None, pad: bool = False
) -> str:
    """Write a Markdown table. With ``pad``, the columns line up in a terminal.

    ``align`` has ``l`` (left) or ``r`` (right) for each column. ``None`` means ``lrr…``.

    Example:
        >>> print(markdown_table(["solver", "µs"], [["epnp", "7"], ["p3p-ransac", "120"]], pad=True))
        | solver     |  µs |
        |------------|----:|
        | epnp       |   7 |
        | p3p-ransac | 120 |
    """
    lines = [list(header), *map(list, rows)]
    widths = [max(2, *map(len, column)) if pad else 0 for column in zip(*lines, strict=True)]
    columns = list(zip(align or "l" + "r" * (len(header) - 1), widths, strict=True))
    rule = ("---:".rjust(width + 2, "-") if side == "r" else "---".ljust(width + 2, "-") for side, width in columns)
    for i, line in enumerate(lines):
        cells = zip(line, columns, strict=True)
        lines[i] = [f" {cell.rjust(width) if side == 'r' else cell.ljust(width)} " for cell, (side, width) in cells]
    return "\n".join(f"|{'|'.join(line)}|" for line in [lines[0], rule, *lines[1:]])
