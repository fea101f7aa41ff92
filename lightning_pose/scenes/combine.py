"""Several scenes as one: frames side by side, each scene in the split it is named for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.scene import Frame, Scene

__all__ = ["join_scenes"]


def join_scenes(train: Sequence[Scene], test: Sequence[Scene]) -> Scene:
    """A scene that trains on some scenes and tests on others.

    A scene that is trained on gives its training and validation frames, and its test frames if it is among `test`
    as well. One that is only tested on gives its official test split, or every frame if it has none: it was never
    seen. Sequences are named `scene/sequence` where there are several scenes.

    Args:
        train: scenes with splits, one or more.
        test: likewise; those of the same folder are the same scene.

    Returns:
        the scene, its `name` both lists (`kitchen to office` where they differ); formats and ground truths that differ
        are joined, that of the last scene tested on at the end.

    Raises:
        DataError: the scenes' units differ.
    """
    known = {scene.root.resolve(): scene for scene in (*train, *test)}
    trained = {scene.root.resolve() for scene in train}
    tested = {scene.root.resolve() for scene in test}
    units = {scene.unit for scene in known.values()}
    if len(units) > 1:
        told = ", ".join(f"{scene.name} in {scene.unit}" for scene in known.values())
        raise DataError(f"positions have different units ({told}); train and test on scenes of one unit")
    frames: list[Frame] = []
    splits: dict[str, list[np.ndarray]] = {"train": [], "val": [], "test": []}
    for root, scene in known.items():
        for split, indices in _select_frames(scene, root in trained, root in tested).items():
            splits[split].append(indices + len(frames))
        named = (replace(frame, sequence=f"{scene.name}/{frame.sequence}") for frame in scene.frames)
        frames += named if len(known) > 1 else scene.frames
    learned, asked = ("+".join(dict.fromkeys(scene.name for scene in part)) for part in (train, test))
    seen = [scene for scene in test if scene.root.resolve() in trained]
    return replace(
        train[0],
        name=learned if learned == asked else f"{learned} to {asked}",
        format=_join_values([scene.format for scene in train], [scene.format for scene in test]),
        frames=tuple(frames),
        splits={split: np.concatenate([np.zeros(0, np.int64), *parts]) for split, parts in splits.items()},
        split_source=seen[0].split_source if seen else "unseen",
        ground_truth=_join_values([scene.ground_truth for scene in train], [scene.ground_truth for scene in test]),
    )


def _join_values(learned: Sequence[str], asked: Sequence[str]) -> str:
    """What scenes say, each value once, those of the scenes tested on last: errors are of these."""
    return "+".join(dict.fromkeys([*(value for value in learned if value not in asked), *asked]))


def _select_frames(scene: Scene, trained: bool, tested: bool) -> dict[str, np.ndarray]:
    """The frames that a scene gives to each split."""
    if trained:
        return {split: scene.splits[split] for split in ("train", "val", *(["test"] if tested else []))}
    whole = np.arange(len(scene.frames))
    return {"test": scene.splits["test"] if scene.split_source == "official" else whole}
