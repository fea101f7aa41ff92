"""A report as people read it: a table on the terminal, in Markdown, in LaTeX."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TextIO

from lightning_pose.reports.table import COSTS, Cell, Mean, Report, Row

if TYPE_CHECKING:
    from rich.text import Text

__all__ = ["Shown", "as_latex", "as_markdown", "print_table"]

MARK = "†"
ABSENT = "–"  # noqa: RUF001
SIZES = ((1e9, "GB"), (1e6, "MB"), (1e3, "kB"))

HEADINGS = {
    "parameters": "parameters",
    "train_seconds": "train s",
    "ms_per_frame": "ms / frame",
    "features_ms_per_frame": "features ms / frame",
    "frame_bytes": "frame bytes",
    "checkpoint_bytes": "checkpoint",
}


@dataclass(frozen=True)
class Shown:
    """Which columns a table has beside the scenes.

    Attributes:
        costs: what a system costs.
        skill: model error over that of the first baseline.
    """

    costs: bool = False
    skill: bool = False


@dataclass(frozen=True)
class Piece:
    """Text, bold or not."""

    text: str
    bold: bool = False


Line = list[list[Piece]]


def print_table(report: Report, shown: Shown, file: TextIO | None = None) -> None:
    """Print the table, and below it what must be said.

    Args:
        report: what to show.
        shown: further columns.
        file: other than the terminal.
    """
    from rich.console import Console
    from rich.table import Table

    stream: TextIO = sys.stdout if file is None else file
    headings, lines = _grid(report, shown)
    table = Table(show_lines=False, title_justify="left")
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="left" if i < 2 else "right", overflow="fold")
    for i, (row, line) in enumerate(zip(report.rows, lines, strict=True)):
        ends = i + 1 < len(lines) and report.rows[i + 1].kind != row.kind
        style = None if row.kind == "own" else "dim"
        table.add_row(*map(_rich, line), style=style, end_section=ends)
    console = Console(file=stream, width=None if stream.isatty() else 1000, highlight=False)
    console.print(table)
    for note in _said(report):
        console.print(note, markup=False, soft_wrap=True)


def as_markdown(report: Report, shown: Shown) -> str:
    """A table in Markdown, and below it a list of what must be said."""
    headings, lines = _grid(report, shown)
    escape: Callable[[str], str] = lambda text: re.sub(r"([|*<\\])", r"\\\1", text)  # noqa: E731
    rows = [[_joined(cell, escape, "**{}**") for cell in line] for line in lines]
    aligned = ["---" if i < 2 else "---:" for i in range(len(headings))]
    table = [f"| {' | '.join(row)} |" for row in ([escape(h) for h in headings], aligned, *rows)]
    return "\n".join([*table, "", *(f"- {escape(note)}" for note in _said(report))])


def as_latex(report: Report, shown: Shown) -> str:
    """A `tabular` for the package booktabs, and below it in small print what must be said."""
    headings, lines = _grid(report, shown)
    out = ["% \\usepackage{booktabs}", f"\\begin{{tabular}}{{ll{'r' * (len(headings) - 2)}}}", "\\toprule"]
    out += [" & ".join(map(_tex, headings)) + r" \\", "\\midrule"]
    for i, (row, line) in enumerate(zip(report.rows, lines, strict=True)):
        if i and report.rows[i - 1].kind != row.kind:
            out.append("\\midrule")
        out.append(" & ".join(_joined(cell, _tex, r"\textbf{{{}}}") for cell in line) + r" \\")
    out += ["\\bottomrule", "\\end{tabular}", "\\par\\smallskip", "{\\footnotesize\\raggedright"]
    out += [f"{_tex(note)}\\par" for note in _said(report)] + ["}"]
    return "\n".join(out)


def _said(report: Report) -> list[str]:
    """Everything below a table, a line each."""
    about = ["Median errors on the test frames, position in metres / orientation in degrees.", *report.captions]
    runs = [f"runs: {report.rule}"]
    return [*about, *runs, *(f"note: {note}" for note in report.notes), *(f"{MARK} {f}" for f in report.footnotes)]


def _grid(report: Report, shown: Shown) -> tuple[list[str], list[Line]]:
    """Headings, and the cells of each row."""
    headings = ["system", "features", *report.scenes, *report.means]
    headings += ["skill m / deg"] if shown.skill else []
    headings += HEADINGS.values() if shown.costs else []
    best = _best(report)
    return headings, [_line(row, report, best, shown) for row in report.rows]


def _line(row: Row, report: Report, best: set[tuple[str, int, str]], shown: Shown) -> Line:
    line = [[Piece(row.system + (f" {MARK}" if row.kind == "published" else ""))], [Piece(row.features)]]
    own = row.kind == "own"
    for scene in report.scenes:
        line.append(_errors(row.cells.get(scene), scene, best if own else set()))
    for column, scenes in report.means.items():
        line.append(_mean(row.means.get(column), column, len(scenes), best if own else set()))
    if shown.skill:
        skill = [row.skill.get(name) for name in ("skill_position", "skill_orientation")]
        line.append([Piece(" / ".join("" if v is None else f"{v:.2f}" for v in skill) if any(skill) else "")])
    if shown.costs:
        line += [[Piece(_cost(name, row.costs.get(name)))] for name in COSTS]
    return line


def _errors(cell: Cell | None, scene: str, best: set[tuple[str, int, str]]) -> list[Piece]:
    if cell is None:
        return [Piece(ABSENT)]
    position, orientation = _texts(cell)
    pieces = [
        Piece(position + _spread(cell.position_std_m, 3), (scene, 0, position) in best),
        Piece(" / "),
        Piece(orientation + _spread(cell.orientation_std_deg, 2), (scene, 1, orientation) in best),
    ]
    return [*pieces, Piece(f" (n={len(cell.runs)})")] if len(cell.runs) > 1 else pieces


def _texts(cell: Cell | Mean) -> tuple[str, str]:
    """Position and orientation as they are shown."""
    if isinstance(cell, Cell) and cell.text is not None:
        return cell.text[0], cell.text[1] or ABSENT
    return _number(cell.position_m, 3), _number(cell.orientation_deg, 2)


def _number(value: float | None, digits: int) -> str:
    return ABSENT if value is None else f"{value:.{digits}f}"


def _spread(std: float | None, digits: int) -> str:
    return "" if std is None else f" ± {std:.{digits}f}"


def _mean(mean: Mean | None, column: str, scenes: int, best: set[tuple[str, int, str]]) -> list[Piece]:
    if mean is None:
        return [Piece(ABSENT)]
    position, orientation = _texts(mean)
    whole = mean.scenes == scenes
    pieces = [
        Piece(position, whole and (column, 0, position) in best),
        Piece(" / "),
        Piece(orientation, whole and (column, 1, orientation) in best),
    ]
    return pieces if whole else [*pieces, Piece(f" [{mean.scenes} of {scenes}]")]


def _best(report: Report) -> set[tuple[str, int, str]]:
    """(column, position or orientation, text) of the user's best, where there are two systems to compare."""
    own = [row for row in report.rows if row.kind == "own"]
    columns: list[tuple[str, list[Cell | Mean]]] = [
        (scene, [row.cells[scene] for row in own if scene in row.cells]) for scene in report.scenes
    ]
    for column, scenes in report.means.items():
        means = [row.means[column] for row in own if column in row.means]
        columns.append((column, [mean for mean in means if mean.scenes == len(scenes)]))
    best = set()
    for name, cells in columns:
        if len(cells) > 1:
            best.add((name, 0, _texts(min(cells, key=lambda cell: _rank(cell.position_m)))[0]))
            best.add((name, 1, _texts(min(cells, key=lambda cell: _rank(cell.orientation_deg)))[1]))
    return best


def _rank(value: float | None) -> float:
    return math.inf if value is None or math.isnan(value) else value


def _cost(name: str, value: float | None) -> str:
    if value is None:
        return ""
    if name.endswith("bytes"):
        return next((f"{value / size:.3g} {unit}" for size, unit in SIZES if value >= size), f"{value:.0f} B")
    return f"{value:,.0f}" if name == "parameters" or value >= 100 else f"{value:.3g}"


def _rich(cell: Sequence[Piece]) -> Text:
    from rich.text import Text

    return Text.assemble(*((piece.text, "bold" if piece.bold else "") for piece in cell))


def _joined(cell: Sequence[Piece], escape: Callable[[str], str], bold: str) -> str:
    return "".join(bold.format(escape(piece.text)) if piece.bold else escape(piece.text) for piece in cell)


TEX = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$",
    MARK: r"$^{\dagger}$", ABSENT: "--", "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}",
    **{c: f"\\{c}" for c in "&%$#_{}"},
}  # fmt: skip


def _tex(text: str) -> str:
    return "".join(TEX.get(character, character) for character in text)
