"""Small tables as text and as HTML: how runs, policies and arms show themselves."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import NamedTuple


class Table(NamedTuple):
    """A title, a header and rows of text."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def text(self) -> str:
        """Columns aligned for a terminal."""
        lines = [self.header, *self.rows]
        widths = [max(len(line[i]) for line in lines) for i in range(len(self.header))]
        padded = ("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)
        return "\n".join([self.title, *(line.rstrip() for line in padded)])

    def html(self) -> str:
        """For notebooks."""
        row = lambda cells, tag: "<tr>" + "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells) + "</tr>"
        body = "".join(row(cells, "td") for cells in self.rows)
        return f"<table><caption>{html.escape(self.title)}</caption>{row(self.header, 'th')}{body}</table>"

    def markdown(self) -> str:
        """For reports: the first column to the left, the others to the right."""
        row = lambda cells: "| " + " | ".join(cells) + " |"
        return "\n".join([row(self.header), "| --- |" + " ---: |" * (len(self.header) - 1), *map(row, self.rows)])
