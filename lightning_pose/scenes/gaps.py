"""Gaps in sequences: where frames are missing, so that neighbours in the list are not neighbours in time."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lightning_pose.scenes.scene import Scene

__all__ = ["describe_gaps", "find_run_starts"]

GAP = 3.5
"""A step of this many usual ones is a gap; a camera that drops one or two frames makes none.

In TUM's freiburg1_rpy the longest steps are 3 frames and 3.1 times the usual time.
"""


def find_run_starts(scene: Scene) -> np.ndarray:
    """Find the frames that begin a run of consecutive frames: the first of each sequence, and those after a gap.

    A gap is a step in number or in time of more than `GAP` times the sequence's median step. Numbers that mostly stay
    the same show nothing, and a sequence without timestamps is judged by its numbers alone.

    Returns:
        (F,) bool.
    """
    sequences = np.array([frame.sequence for frame in scene.frames])
    starts = np.ones(len(sequences), bool)
    starts[1:] = sequences[1:] != sequences[:-1]
    for first, end in pairwise([*np.flatnonzero(starts), len(sequences)]):
        frames = scene.frames[first:end]
        starts[first + 1 : end] |= _find_long_steps([frame.index for frame in frames])
        times = [frame.timestamp for frame in frames if frame.timestamp is not None]
        if len(times) == len(frames):
            starts[first + 1 : end] |= _find_long_steps(times)
    return starts


def describe_gaps(scene: Scene) -> str | None:
    """How many runs the scene's sequences have, and where the first gap is; None without a gap."""
    starts = find_run_starts(scene)
    names = [frame.sequence for frame in scene.frames]
    after_gap = [i for i in np.flatnonzero(starts) if i and names[i] == names[i - 1]]
    if not after_gap:
        return None
    before, after = scene.frames[after_gap[0] - 1], scene.frames[after_gap[0]]
    gaps = "1 gap" if len(after_gap) == 1 else f"{len(after_gap)} gaps"
    return (
        f"{gaps}, so that there are {int(starts.sum())} runs of consecutive frames in {len(set(names))} sequences, and "
        f"no clip crosses a gap; the first is in {before.sequence}, from {before.image.name} to {after.image.name}"
    )


def _find_long_steps(values: list[int] | list[float]) -> np.ndarray:
    """Which of the steps between M values, (M - 1,) bool, are much longer than their median."""
    steps = np.abs(np.diff(np.asarray(values, np.float64)))
    usual = np.median(steps) if len(steps) else 0.0
    return steps > GAP * usual if usual > 0 else np.zeros(len(steps), bool)
