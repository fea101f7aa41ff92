"""The table that a test prints."""

from __future__ import annotations

import sys
from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

__all__ = ["print_results", "results_markdown"]

COLUMNS = {
    "position_median_m": ("median\nm", "{:.3f}"),
    "orientation_median_deg": ("median\ndeg", "{:.2f}"),
    "position_mean_m": ("mean\nm", "{:.3f}"),
    "orientation_mean_deg": ("mean\ndeg", "{:.2f}"),
    "position_p95_m": ("95 %\nm", "{:.3f}"),
    "orientation_p95_deg": ("95 %\ndeg", "{:.2f}"),
    "recall_5cm_5deg": ("5 cm\n5 deg", "{:.0%}"),
    "recall_10cm_5deg": ("10 cm\n5 deg", "{:.0%}"),
    "recall_25cm_2deg": ("25 cm\n2 deg", "{:.0%}"),
    "recall_50cm_5deg": ("50 cm\n5 deg", "{:.0%}"),
}

IN_MARKDOWN = (
    "position_median_m",
    "orientation_median_deg",
    "position_p95_m",
    "orientation_p95_deg",
    "recall_5cm_5deg",
    "recall_10cm_5deg",
)


def print_results(results: Mapping[str, Mapping[str, float]], title: str, extras: Mapping[str, float]) -> None:
    """Print one row a system, best known facts first, and the skill and costs below."""
    table = Table(title=title, caption="  ".join(_said(name, value) for name, value in extras.items()))
    table.add_column("test")
    for heading, _ in COLUMNS.values():
        table.add_column(heading, justify="right")
    for i, (system, metrics) in enumerate(results.items()):
        cells = [form.format(metrics[name]) for name, (_, form) in COLUMNS.items()]
        table.add_row(system, *cells, style="bold" if i == 0 else None, end_section=i == 0)
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def results_markdown(results: Mapping[str, Mapping[str, float]], extras: Mapping[str, float]) -> str:
    """The same in Markdown: fewer columns and no title, because MLflow shows a narrow description, and folds it."""
    columns = {name: COLUMNS[name] for name in IN_MARKDOWN}
    lines = [
        f"| test | {' | '.join(heading.replace(chr(10), ' ') for heading, _ in columns.values())} |",
        f"|---|{'---:|' * len(columns)}",
    ]
    for i, (system, metrics) in enumerate(results.items()):
        cells = [form.format(metrics[name]) for name, (_, form) in columns.items()]
        lines.append(f"| {' | '.join([f'**{system}**' if i == 0 else system, *cells])} |")
    return "\n".join([*lines, "", "; ".join(_said(name, value) for name, value in extras.items())])


def _said(name: str, value: float) -> str:
    """`cost/train_seconds` 12.34 as `train seconds 12.3`."""
    number = f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
    return f"{name.partition('/')[2].replace('_', ' ')} {number}"
