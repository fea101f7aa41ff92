"""Held-out blocks: whole, spread, disjoint, deterministic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes.scene import Frame, Scene
from lightning_pose.scenes.splits import hold_out, make_splits


def scene(lengths: list[int], official: bool = False) -> Scene:
    """Sequences of these lengths; with `official`, the last one is the test split."""
    zero, unit = np.zeros(3), np.array([1.0, 0, 0, 0])
    frames = tuple(
        Frame(Path(f"{s}/{i}.png"), zero, unit, f"seq-{s:02d}", i) for s, n in enumerate(lengths) for i in range(n)
    )
    border = len(frames) - lengths[-1] if lengths else 0
    splits = {"train": np.arange(border), "test": np.arange(border, len(frames))} if official else {}
    return Scene("room", Path("room"), "own", frames, splits)


def blocks(indices: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each run of consecutive ones."""
    runs = np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
    return [(int(run[0]), int(run[-1])) for run in runs]


def test_short_sequences_are_held_out_in_halves() -> None:
    """13 sequences of 50, 65 frames wanted: last and first halves of four, spread, as on redkitchen."""
    splits = make_splits(scene([50] * 13 + [150], official=True), 0.1, 0.2)
    assert blocks(splits["val"]) == [(75, 99), (200, 224), (425, 449), (550, 574)]
    assert {k: len(v) for k, v in splits.items()} == {"train": 550, "val": 100, "test": 150}
    np.testing.assert_array_equal(splits["test"], np.arange(650, 800))


def test_long_sequences_are_held_out_in_blocks() -> None:
    """A sequence of 1000 is far more than the 200 frames wanted: four blocks of 50, two a sequence."""
    splits = make_splits(scene([1000, 1000, 500], official=True), 0.1, 0.2)
    assert blocks(splits["val"]) == [(225, 274), (725, 774), (1225, 1274), (1725, 1774)]


def test_one_trajectory_without_a_split() -> None:
    splits = make_splits(scene([373]), 0.1, 0.2)
    assert {k: len(v) for k, v in splits.items()} == {"train": 268, "val": 30, "test": 75}
    assert len(blocks(splits["test"])) == 4
    assert [last - first + 1 for first, last in blocks(splits["val"])] == [10, 10, 10]


@pytest.mark.parametrize("lengths", [[10], [100], [5] * 30, [7, 300, 2, 60], [1] * 40, [3000]])
@pytest.mark.parametrize("official", [True, False])
def test_splits_are_a_partition(lengths: list[int], official: bool) -> None:
    lengths = [*lengths, 10]
    room = scene(lengths, official)
    splits, again = make_splits(room, 0.1, 0.2), make_splits(room, 0.1, 0.2)
    np.testing.assert_array_equal(np.sort(np.concatenate(list(splits.values()))), np.arange(sum(lengths)))
    for name in splits:
        assert len(splits[name]) > 0
        assert np.issubdtype(splits[name].dtype, np.integer)
        assert np.all(np.diff(splits[name]) > 0)
        np.testing.assert_array_equal(splits[name], again[name])


def test_blocks_stay_within_a_sequence() -> None:
    room = scene([100, 100, 10], official=True)
    for first, last in blocks(make_splits(room, 0.3, 0.2)["val"]):
        assert room.frames[first].sequence == room.frames[last].sequence


def test_zero_leaves_validation_empty() -> None:
    splits = make_splits(scene([20, 5], official=True), 0, 0.2)
    assert len(splits["val"]) == 0
    assert len(splits["train"]) == 20


@pytest.mark.parametrize("fraction", [-0.1, 1.5, float("nan")])
def test_fraction_out_of_range(fraction: float) -> None:
    with pytest.raises(ConfigError, match=rf"val_fraction is {fraction}; give a part between 0 and 1"):
        make_splits(scene([20, 5], official=True), fraction, 0.2)


def test_fraction_that_leaves_nothing() -> None:
    with pytest.raises(ConfigError, match=r"val_fraction 0.99 leaves none of 20 frames to train on; lower it"):
        make_splits(scene([20, 5], official=True), 0.99, 0.2)
    with pytest.raises(ConfigError, match=r"test_fraction 1.0 leaves none"):
        make_splits(scene([20]), 0.1, 1.0)


def test_no_frames() -> None:
    with pytest.raises(DataError, match=r"room holds no posed image; check"):
        make_splits(scene([]), 0.1, 0.2)


@pytest.mark.parametrize(("block", "runs"), [(1, 4), (25, 4), (26, 2), (50, 2)])
def test_validation_comes_in_runs_of_a_block(block: int, runs: int) -> None:
    """13 sequences of 50 frames: halves if a block fits into one, else whole sequences."""
    sequences = np.repeat([f"seq-{i:02d}" for i in range(13)], 50)
    kept, held = hold_out(np.arange(650), sequences, 0.1, "val_fraction", block)
    assert sorted([*kept, *held]) == list(range(650))
    parts = np.split(held, np.flatnonzero(np.diff(held) > 1) + 1)
    assert len(parts) == runs
    assert min(map(len, parts)) >= block
    assert all(len(set(sequences[part])) == 1 for part in parts)


def test_blocks_of_one_trajectory_are_long_enough() -> None:
    kept, held = hold_out(np.arange(300), np.full(300, "one"), 0.1, "val_fraction", 50)
    assert len(held) == 50
    assert len(kept) == 250
    assert (np.diff(held) == 1).all()
