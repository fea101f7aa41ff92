"""The table that a test prints."""

from __future__ import annotations

import sys
from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

from lightning_pose.metrics.catalog import ERRORS, find_metric, format_number

__all__ = ["print_results", "results_markdown"]


def print_results(results: Mapping[str, Mapping[str, float]], title: str, extras: Mapping[str, float]) -> None:
    """Print one row a system, the metrics that the catalogue marks as printed, and the skill and costs below.

    Args:
        results: system to its metrics, the model first.
        title: above the table.
        extras: below the table, by whole name.
    """
    columns = {name: metric for name, metric in ERRORS.items() if metric.printed}
    table = Table(title=title, caption="  ".join(_describe_extra(name, value) for name, value in extras.items()))
    table.add_column("test")
    for metric in columns.values():
        table.add_column(metric.heading, justify="right")
    for i, (system, metrics) in enumerate(results.items()):
        cells = [metric.format(metrics[name]) for name, metric in columns.items()]
        table.add_row(system, *cells, style="bold" if i == 0 else None, end_section=i == 0)
    Console(width=None if sys.stdout.isatty() else 120, markup=False, emoji=False).print(table)


def results_markdown(results: Mapping[str, Mapping[str, float]], extras: Mapping[str, float]) -> str:
    """The same in Markdown: fewer columns and no title, because MLflow shows a narrow description, and folds it."""
    columns = {name: metric for name, metric in ERRORS.items() if metric.described}
    lines = [
        f"| test | {' | '.join(metric.heading.replace(chr(10), ' ') for metric in columns.values())} |",
        f"|---|{'---:|' * len(columns)}",
    ]
    for i, (system, metrics) in enumerate(results.items()):
        cells = [metric.format(metrics[name]) for name, metric in columns.items()]
        lines.append(f"| {' | '.join([f'**{system}**' if i == 0 else system, *cells])} |")
    return "\n".join([*lines, "", "; ".join(_describe_extra(name, value) for name, value in extras.items())])


def _describe_extra(name: str, value: float) -> str:
    """`cost/train_seconds` 12.34 as `train seconds 12.3`."""
    metric = find_metric(name)
    number = metric.format(value) if metric is not None and metric.form == ".0%" else format_number(value)
    return f"{name.partition('/')[2].replace('_', ' ')} {number}"
