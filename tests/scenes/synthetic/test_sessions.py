"""Visits of a synthetic room: what changes from one to the next, and what stays."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import ConfigError
from lightning_pose.scenes.synthetic import render_room
from lightning_pose.scenes.synthetic.sessions import move_furniture

SIZE_M = np.array([6.0, 4.0, 2.7])
STANDING = [[(x, 1.4, 0), (x + 0.8, 1.9, 0.7)] for x in (-2.8, -1.6, -0.4, 0.8)]
UPON = [[(low[0] + 0.1, 1.5, 0.7), (low[0] + 0.4, 1.7, 0.9)] for low, _ in STANDING]
BOXES = np.array(STANDING + UPON, float)


@pytest.mark.parametrize("number", range(1, 9))
def test_furniture_moves_with_what_stands_on_it_and_touches_nothing(number: int) -> None:
    shift_m, kept = move_furniture(0, number, SIZE_M, BOXES)
    moved = BOXES + shift_m[:, None]
    assert (shift_m[:4] == shift_m[4:]).all()
    assert kept[:4].all()
    assert (np.abs(moved[..., :2]) < SIZE_M[:2] / 2).all()
    for a, b in combinations(moved[:4, :, :2], 2):
        assert ((a[0] > b[1]) | (b[0] > a[1])).any()


def test_some_furniture_moves_some_boxes_are_gone_and_nothing_at_the_first_visit() -> None:
    drawn = [move_furniture(0, number, SIZE_M, BOXES) for number in range(1, 9)]
    assert 0.2 < np.mean([shift[:4].any(1) for shift, _ in drawn]) < 0.8
    assert 0.4 < np.mean([kept[4:] for _, kept in drawn]) < 0.95
    shift_m, kept = move_furniture(0, 0, SIZE_M, BOXES)
    assert not shift_m.any()
    assert kept.all()


@pytest.mark.parametrize("sessions", [0, 4])
def test_a_session_needs_two_frames(tmp_path: Path, sessions: int) -> None:
    with pytest.raises(ConfigError, match=rf"sessions is {sessions}; give 1 to 3, so that each has 2 of the 7 frames"):
        render_room(tmp_path / "room", 0, 7, (64, 48), sessions=sessions)
