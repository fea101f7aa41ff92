"""The table that a test prints."""

from __future__ import annotations

import sys
from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

__all__ = ["print_results"]

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


def _said(name: str, value: float) -> str:
    """`cost/train_seconds` 12.34 as `train seconds 12.3`."""
    number = f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
    return f"{name.partition('/')[2].replace('_', ' ')} {number}"
