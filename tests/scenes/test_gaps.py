"""Gaps in sequences: by number, by time, and what is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightning_pose.data.clip_dataset import find_runs
from lightning_pose.scenes.gaps import describe_gaps, find_run_starts
from lightning_pose.scenes.scene import Frame, Scene
from lightning_pose.scenes.splits import make_splits


def scene(numbers: list[int], times: list[float] | None = None, sequence: str = "a") -> Scene:
    stamps = times or [None] * len(numbers)
    frames = (
        Frame(Path(f"{n}.png"), np.zeros(3), np.eye(4)[0], sequence, n, t) for n, t in zip(numbers, stamps, strict=True)
    )
    return Scene("s", Path("s"), "none", tuple(frames))


def starts(scene: Scene) -> list[int]:
    return np.flatnonzero(find_run_starts(scene)).tolist()


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ([0, 1, 2, 3, 4, 15, 16, 17], [0, 5]),  # ten frames are missing
        ([0, 1, 2, 3, 7, 8, 9], [0, 4]),
        ([0, 1, 3, 4, 7, 8, 9, 10], [0]),  # one and two frames are missing
        ([0, 5, 10, 15, 20, 70, 75, 80], [0, 5]),  # every fifth frame is kept
        ([7, 7, 7, 7, 7, 7], [0]),
        ([7, 7, 7, 7, 7, 90], [0]),
        ([3], [0]),
        ([], []),
    ],
)
def test_a_run_ends_where_numbers_step_far(numbers: list[int], expected: list[int]) -> None:
    assert starts(scene(numbers)) == expected


def test_a_run_ends_where_time_steps_far() -> None:
    times = [0.0, 0.033, 0.066, 0.1, 4.2, 4.233, 4.266]
    assert starts(scene(list(range(7)), times)) == [0, 4]
    jitter = [0.0, 0.033, 0.066, 0.166, 0.2, 0.233]  # two frames late
    assert starts(scene(list(range(6)), jitter)) == [0]


def test_each_sequence_has_its_own_usual_step() -> None:
    slow, fast = scene([0, 30, 60, 90], sequence="a"), scene([0, 1, 2, 3], sequence="b")
    joined = Scene("s", Path("s"), "none", slow.frames + fast.frames)
    assert starts(joined) == [0, 4]


def test_runs_of_a_split_end_at_gaps_and_their_number_is_said() -> None:
    holed = scene([*range(10), *range(20, 30), *range(60, 70)])
    assert [len(run) for run in find_runs(holed, np.arange(30))] == [10, 10, 10]
    said = describe_gaps(holed)
    assert said is not None
    assert "2 gaps" in said
    assert "3 runs" in said
    assert "from 9.png to 20.png" in said
    assert describe_gaps(scene(list(range(10)))) is None


def test_blocks_that_are_held_out_cross_no_gap() -> None:
    holed = scene([*range(35), *range(300, 365)])
    splits = make_splits(holed, 0.1, 0.2, val_block=10)
    for split in ("val", "test"):
        assert all(len(run) >= 10 for run in find_runs(holed, splits[split])), split
