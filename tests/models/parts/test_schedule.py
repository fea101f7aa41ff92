"""The schedule's known values."""

from __future__ import annotations

import pytest

from lightning_pose.models.parts.schedule import cosine_factor


def test_known_factors() -> None:
    factors = [cosine_factor(step, 40) for step in (0, 1, 2, 21, 40)]
    assert factors == pytest.approx([0.5, 1.0, 1.0, 0.5, 0.0])


def test_a_run_of_one_step_has_the_highest_rate() -> None:
    assert cosine_factor(0, 1) == 1.0
