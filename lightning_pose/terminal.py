"""Tables of text: for the terminal, with rows and columns exchanged where only that fits, and in Markdown."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.markup import escape
from rich.table import Table

__all__ = ["Sheet", "escape_markdown", "format_markdown"]

UNKNOWN_WIDTH = 120  # characters; for output into a file or another process


@dataclass(frozen=True)
class Sheet:
    """A table of plain text.

    Attributes:
        title: line above the table.
        heads: heads of the columns.
        rows: rows of cells, one cell for each head.
        caption: line below the table.
    """

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str | None = None

    def show(self, width: int | None = None) -> None:
        """Print the table; exchange rows and columns if only then it fits.

        Args:
            width: of the terminal in characters; by default it is found out.
        """
        console = Console(width=width or (None if sys.stdout.isatty() else UNKNOWN_WIDTH), emoji=False)
        columns = list(zip(self.heads, *self.rows, strict=True))
        usual = _find_least_width([[*head.split(), *cells] for head, *cells in columns])
        exchanged = _find_least_width([[word for head in self.heads for word in head.split()], *self.rows])
        exchange = usual > console.width >= exchanged
        console.print(self._table(None, columns) if exchange else self._table(self.heads, self.rows))

    def _table(self, heads: Sequence[str] | None, rows: Sequence[Sequence[str]]) -> Table:
        """Make a table of these rows; without `heads` the first column holds them, aligned left."""
        caption = None if self.caption is None else escape(self.caption)
        table = Table(
            title=escape(self.title),
            title_justify="left",
            caption=caption,
            show_header=heads is not None,
            show_lines=False,
        )
        for i in range(len(rows[0]) if rows else 0):
            name = "" if heads is None else escape(heads[i])
            table.add_column(name, justify="left" if heads is None and i == 0 else "right", overflow="fold")
        for row in rows:
            table.add_row(*map(escape, row))  # a reason may have brackets
        return table


def escape_markdown(text: str) -> str:
    """The text as Markdown shows it, with a backslash before each character that Markdown reads as its own."""
    return re.sub(r"([|*<\\])", r"\\\1", text)


def format_markdown(heads: Sequence[str], rows: Sequence[Sequence[str]], texts: int | None = None) -> str:
    """A table in Markdown, a line each for the heads, the alignment and every row.

    Args:
        heads: heads of the columns.
        rows: rows of cells, one cell for each head.
        texts: how many columns hold text; the others are aligned right. All by default.
    """
    count = len(heads) if texts is None else texts
    aligned = ["---" if i < count else "---:" for i in range(len(heads))]
    escaped = [[escape_markdown(cell) for cell in row] for row in (heads, *rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (escaped[0], aligned, *escaped[1:]))


def _find_least_width(columns: Sequence[Sequence[str]]) -> int:
    """Width in characters of a table whose columns hold these texts, none of them broken into lines."""
    return 1 + sum(3 + max(map(len, column), default=0) for column in columns)
