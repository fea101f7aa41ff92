"""What tests of reports share: a report in few words."""

from __future__ import annotations

from lightning_pose.reports.table import Report

__all__ = ["shown"]


def shown(report: Report) -> dict[str, dict[str, float]]:
    """Position errors by system and scene."""
    return {row.system: {scene: cell.errors[0] for scene, cell in row.cells.items()} for row in report.rows}
