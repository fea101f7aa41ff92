"""A report as people read it: a table on the terminal, in Markdown, in LaTeX."""

from __future__ import annotations

import math
import re
import sys
from typing import TextIO

from lightning_pose.metrics.catalog import COSTS, ERRORS, MEDIANS, SKILLS
from lightning_pose.reports.table import Cell, Report
from lightning_pose.terminal import escape_markdown, format_markdown

__all__ = ["as_latex", "as_markdown", "print_table"]

MARK = "†"
ABSENT = "–"  # noqa: RUF001
BOLD, END = "\x02", "\x03"
"""Around bold text in a cell, until a format replaces them by its own marks."""

TEX = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$",
    MARK: r"$^{\dagger}$", ABSENT: "--", "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}",
    BOLD: r"\textbf{", END: "}", **{c: f"\\{c}" for c in "&%$#_{}"},
}  # fmt: skip


def print_table(report: Report, file: TextIO | None = None) -> None:
    """Print the table, and the notes below it.

    Args:
        report: what to show.
        file: other than the terminal.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    stream: TextIO = sys.stdout if file is None else file
    headings, *lines = _format_table(report)
    table = Table(show_lines=False, title_justify="left")
    for i, heading in enumerate(headings):
        table.add_column(escape(heading), justify="left" if i < 2 else "right", overflow="fold")
    for i, (row, line) in enumerate(zip(report.rows, lines, strict=True)):
        ends = i + 1 < len(lines) and report.rows[i + 1].kind != row.kind
        cells = [escape(cell).replace(BOLD, "[bold]").replace(END, "[/bold]") for cell in line]
        table.add_row(*cells, style=None if row.kind == "own" else "dim", end_section=ends)
    console = Console(file=stream, width=None if stream.isatty() else 1000, highlight=False, emoji=False)
    console.print(table)
    for note in _list_notes(report):
        console.print(note, markup=False, soft_wrap=True)


def as_markdown(report: Report) -> str:
    """A table in Markdown, and below it a list of notes."""
    headings, *rows = _format_table(report)
    table = re.sub(f"[{BOLD}{END}]", "**", format_markdown(headings, rows, texts=2))
    return "\n".join([table, "", *(f"- {escape_markdown(note)}" for note in _list_notes(report))])


def as_latex(report: Report) -> str:
    """A `tabular` for the package booktabs, and below it the notes in small print."""
    table = _format_table(report)
    headings, *lines = [" & ".join(map(_escape_latex, line)) + r" \\" for line in table]
    out = ["% \\usepackage{booktabs}", f"\\begin{{tabular}}{{ll{'r' * (len(table[0]) - 2)}}}", "\\toprule", headings]
    for i, (row, line) in enumerate(zip(report.rows, lines, strict=True)):
        out += [line] if i and report.rows[i - 1].kind == row.kind else ["\\midrule", line]
    out += ["\\bottomrule", "\\end{tabular}", "\\par\\smallskip", "{\\footnotesize\\raggedright"]
    return "\n".join([*out, *(f"{_escape_latex(note)}\\par" for note in _list_notes(report)), "}"])


def _escape_latex(text: str) -> str:
    return "".join(TEX.get(character, character) for character in text)


def _list_notes(report: Report) -> list[str]:
    """Everything below a table, a line each."""
    about = ["Median errors on the test frames, position in metres / orientation in degrees.", *report.captions]
    notes = [f"runs: {report.rule}", *(f"note: {note}" for note in report.notes)]
    return [*about, *notes, *(f"{MARK} {footnote}" for footnote in report.footnotes)]


def _format_table(report: Report) -> list[list[str]]:
    """Headings, and the cells of each row."""
    headings = ["system", "features", *report.scenes, *report.means]
    headings += ["skill m / deg"] if "skill" in report.further else []
    headings += [cost.heading for cost in COSTS.values()] if "costs" in report.further else []
    sizes = [1] * len(report.scenes) + [len(scenes) for scenes in report.means.values()]
    cells = [[*map(row.cells.get, report.scenes), *map(row.means.get, report.means)] for row in report.rows]
    own = [line for row, line in zip(report.rows, cells, strict=True) if row.kind == "own"]
    best = [_find_best([line[i] for line in own], size) for i, size in enumerate(sizes)]
    lines = [headings]
    for row, line in zip(report.rows, cells, strict=True):
        marked = best if row.kind == "own" else [("", "")] * len(sizes)
        averages = row.average_costs()
        texts = [row.system + (f" {MARK}" if row.kind == "published" else ""), row.features]
        texts += map(_format_cell, line, sizes, marked)
        if "skill" in report.further:
            skill = [SKILLS[name].format(averages[name]) if name in averages else "" for name in SKILLS]
            texts.append(" / ".join(skill) if any(skill) else "")
        if "costs" in report.further:
            texts += [cost.format(averages[name]) if name in averages else "" for name, cost in COSTS.items()]
        lines.append(texts)
    return lines


def _format_cell(cell: Cell | None, size: int, best: tuple[str, str]) -> str:
    """Both errors, bold where they are the best of a column of means over so many scenes, and what they are over."""
    if cell is None:
        return ABSENT
    parts = []
    for i, text in enumerate(_format_errors(cell)):
        spread = f" ± {ERRORS[MEDIANS[i]].format(cell.deviations[i])}" if cell.deviations else ""
        parts.append(f"{BOLD}{text}{spread}{END}" if text == best[i] and cell.scenes == size else text + spread)
    over = f" (n={len(cell.runs)})" if len(cell.runs) > 1 else f" [{cell.scenes} of {size}]"
    return " / ".join(parts) + (over if len(cell.runs) > 1 or cell.scenes != size else "")


def _format_errors(cell: Cell) -> tuple[str, str]:
    """Position and orientation as they are shown."""
    if cell.text is not None:
        return cell.text[0], cell.text[1] or ABSENT
    position, orientation = (
        ABSENT if error is None else ERRORS[name].format(error)
        for name, error in zip(MEDIANS, cell.errors, strict=True)
    )
    return position, orientation


def _find_best(column: list[Cell | None], size: int) -> tuple[str, str]:
    """The lowest errors of a column of means over so many scenes, as they are shown; empty where there are no two."""
    cells = [cell for cell in column if cell and cell.scenes == size]
    if len(cells) < 2:
        return "", ""
    nearest = min(cells, key=lambda cell: _sort_error(cell.errors[0]))
    straightest = min(cells, key=lambda cell: _sort_error(cell.errors[1]))
    return _format_errors(nearest)[0], _format_errors(straightest)[1]


def _sort_error(error: float | None) -> float:
    """A key that sorts what is missing or not a number last."""
    return math.inf if error is None or math.isnan(error) else error
