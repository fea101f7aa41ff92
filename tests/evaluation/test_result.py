"""Skill: a model's errors over a baseline's."""

from __future__ import annotations

from lightning_pose.evaluation.result import skill
from lightning_pose.metrics.catalog import MEDIANS


def test_a_baseline_without_error_gives_no_skill() -> None:
    position, orientation = MEDIANS
    found = skill({position: 0.1, orientation: 2.0}, {position: 0.0, orientation: 4.0})
    assert found == {"test/skill_orientation": 0.5}
