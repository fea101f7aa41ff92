"""Chooses frames for training, validation and test: official splits if a dataset has them, otherwise held-out blocks.

Frames of a video are nearly copies of their neighbours, so the error of a single held-out frame, or of a short block,
is not that of a new place. One or two long blocks are too few places. Measured on the training split of 7-Scenes'
redkitchen, cut to 13 sequences of 50 frames, where the mean pose is 0.55 m off (median; 0.59 m on the test split,
whose frames lie 9 cm from the nearest training pose):

| held out                    | frames | to the nearest training pose | off the mean pose |
|-----------------------------|--------|------------------------------|-------------------|
| two whole sequences         | 100    | 13 cm                        | 0.22 m            |
| halves of four sequences    | 100    | 4 cm                         | 0.47 m            |

The two whole sequences happen to lie in the middle, where a network that has learned nothing has small errors: by
them, the best checkpoint was that of the first epoch. The frames are therefore, in this order:

- halves of at least four sequences, evenly spaced among the sequences, first and last halves in turn;
- if that would be more than twice the wanted fraction (there are only a few sequences), contiguous blocks, evenly
  spaced over the trajectory: at most four, and each of at least 10 frames if so many are wanted.

The choice is deterministic.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes.gaps import find_run_starts
from lightning_pose.scenes.scene import Scene

__all__ = ["hold_out", "make_splits"]

MAX_BLOCKS = 4
"""Most blocks, and least halves of sequences, to hold out."""

MIN_BLOCK = 10
"""Frames that a block has at least, if so many are wanted."""


def make_splits(
    scene: Scene, val_fraction: float, test_fraction: float, val_block: int = 1
) -> Mapping[str, np.ndarray]:
    """Ascending frame indices of `train`, `val` and `test`, disjoint.

    Args:
        scene: with the official `train` and `test` in `splits`, perhaps with `val`, or with empty `splits`.
        val_fraction: part of the training frames to validate on; 0 leaves `val` empty.
        test_fraction: part of all frames to test on, if the scene has no official split.
        val_block: see `hold_out`.

    Raises:
        ConfigError: a fraction is outside 0..1, or leaves no frame to train on.
        DataError: the scene has no frames.
    """
    if not scene.frames:
        raise DataError(f"{scene.root} holds no posed image; check that the download is complete")
    sequences = np.array([frame.sequence for frame in scene.frames])
    runs = np.cumsum(find_run_starts(scene))
    if scene.splits:
        train, test = scene.splits["train"], scene.splits["test"]
    else:
        train, test = hold_out(np.arange(len(sequences)), sequences, test_fraction, "test_fraction", runs=runs)
    if "val" in scene.splits:
        return {"train": train, "val": scene.splits["val"], "test": test}
    train, val = hold_out(train, sequences, val_fraction, "val_fraction", val_block, runs)
    return {"train": train, "val": val, "test": test}


def hold_out(
    indices: np.ndarray,
    sequences: np.ndarray,
    fraction: float,
    setting: str,
    block: int = 1,
    runs: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Divide frames into those kept and those held out.

    Args:
        indices: (N,) ascending frame indices to divide.
        sequences: the sequence of every frame of the scene.
        fraction: about which part of them to hold out; at least one frame unless it is 0.
        setting: name of the fraction in the user's settings, for the message.
        block: least number of consecutive frames to hold out (clips need them), if sequences are that long; whole
            sequences or longer blocks are chosen where halves are shorter.
        runs: the run of consecutive frames that every frame of the scene is in; its sequence if not given.

    Returns:
        the kept and the held-out indices, ascending.

    Raises:
        ConfigError: see `make_splits`.
    """
    if not 0 <= fraction <= 1:
        raise ConfigError(f"{setting} is {fraction}; give a part between 0 and 1, such as 0.1")
    if fraction == 0:
        return indices, indices[:0]
    wanted = max(1, round(fraction * len(indices)))
    if wanted >= len(indices):
        raise ConfigError(
            f"{setting} {fraction} leaves none of {len(indices)} frames to train on; "
            "lower it, or give a scene with more frames"
        )
    held = _choose_halves(indices, sequences[indices], wanted, block)
    if held is None:
        held = _choose_sequences(indices, sequences[indices], wanted, block)
    if held is None:
        held = _choose_blocks(indices, sequences if runs is None else runs, wanted, block)
    return np.setdiff1d(indices, held), held


def _choose_halves(indices: np.ndarray, sequence_of: np.ndarray, wanted: int, block: int) -> np.ndarray | None:
    """Halves of evenly spaced sequences, `wanted` frames or more.

    None if that would be more than twice as many frames, or if a half is shorter than a block.
    """
    names, lengths = _count_sequences(sequence_of)
    half = int(np.median(lengths)) // 2
    if half < block or MAX_BLOCKS * half > 2 * wanted:
        return None
    count = max(MAX_BLOCKS, -(-wanted // half))
    if count > len(names):
        return None
    held = []
    for i, place in enumerate(_space_evenly(count, len(names))):
        members = indices[sequence_of == names[place]]
        middle = len(members) // 2
        held.append(members[middle:] if i % 2 == 0 else members[:middle])
    return np.sort(np.concatenate(held))


def _choose_sequences(indices: np.ndarray, sequence_of: np.ndarray, wanted: int, block: int) -> np.ndarray | None:
    """Evenly spaced whole sequences, `wanted` frames or more.

    None unless half a sequence is shorter than a block and a whole one is not; None if that would be more than twice
    as many frames, or every sequence.
    """
    names, lengths = _count_sequences(sequence_of)
    length = int(np.median(lengths))
    count = -(-wanted // length)
    if not length // 2 < block <= length or length > 2 * wanted or count >= len(names):
        return None
    return indices[np.isin(sequence_of, [names[place] for place in _space_evenly(count, len(names))])]


def _count_sequences(sequence_of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Names of sequences in the scene's order, and how many frames each has."""
    names, first, lengths = np.unique(sequence_of, return_index=True, return_counts=True)
    order = np.argsort(first)
    return names[order], lengths[order]


def _choose_blocks(indices: np.ndarray, run_of: np.ndarray, wanted: int, block: int) -> np.ndarray:
    """Evenly spaced blocks, `wanted` frames together, none of them across a gap or the end of a sequence."""
    breaks = np.flatnonzero((np.diff(indices) > 1) | (run_of[indices[1:]] != run_of[indices[:-1]])) + 1
    runs = np.array([0, *breaks, len(indices)])
    count = min(max(wanted // max(MIN_BLOCK, block), 1), MAX_BLOCKS)
    lengths = [max(block, len(part)) for part in np.array_split(np.arange(wanted), count)]
    held = []
    for centre, length in zip(_space_evenly(count, len(indices)), lengths, strict=True):
        run = np.searchsorted(runs, centre, side="right") - 1
        length = min(length, runs[run + 1] - runs[run])
        start = np.clip(centre - length // 2, runs[run], runs[run + 1] - length)
        held.append(indices[start : start + length])
    return np.unique(np.concatenate(held))


def _space_evenly(count: int, total: int) -> list[int]:
    """The middles of `count` equal parts of 0..total-1."""
    return [(2 * i + 1) * total // (2 * count) for i in range(count)]
