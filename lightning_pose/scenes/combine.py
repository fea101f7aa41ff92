"""Several scenes joined into one, some of them to train on and some to test on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.scene import Frame, Scene

__all__ = ["join_scenes"]


def join_scenes(train: Sequence[Scene], test: Sequence[Scene]) -> Scene:
    """Join scenes into one whose training frames are of some of them and whose test frames are of others.

    Of a scene in `train` the training and validation frames are used, and the test frames if it is in `test` as well.
    Of a scene in `test` alone the official test split is used, or every frame if it has none, because no frame of it
    is trained on. If there are several scenes, sequences are named `scene/sequence`.

    Args:
        train: scenes with splits, one or more.
        test: likewise; scenes of the same folder are one scene.

    Returns:
        the joined scene. Its name holds both lists (`kitchen to office`) if they differ. Formats and ground truths that
        differ are joined with `+`, those of test scenes last.

    Raises:
        DataError: the scenes' units differ.
    """
    known = {scene.root.resolve(): scene for scene in (*train, *test)}
    trained = {scene.root.resolve() for scene in train}
    tested = {scene.root.resolve() for scene in test}
    units = {scene.unit for scene in known.values()}
    if len(units) > 1:
        named = ", ".join(f"{scene.name} in {scene.unit}" for scene in known.values())
        raise DataError(f"positions have different units ({named}); train and test on scenes of one unit")
    frames: list[Frame] = []
    splits: dict[str, list[np.ndarray]] = {"train": [], "val": [], "test": []}
    for root, scene in known.items():
        for split, indices in _select_frames(scene, root in trained, root in tested).items():
            splits[split].append(indices + len(frames))
        renamed = (replace(frame, sequence=f"{scene.name}/{frame.sequence}") for frame in scene.frames)
        frames += renamed if len(known) > 1 else scene.frames
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
    """Each value once, joined with `+`; those of the test scenes last, because errors are measured there."""
    return "+".join(dict.fromkeys([*(value for value in learned if value not in asked), *asked]))


def _select_frames(scene: Scene, trained: bool, tested: bool) -> dict[str, np.ndarray]:
    """The scene's frames that go into each split."""
    if trained:
        return {split: scene.splits[split] for split in ("train", "val", *(["test"] if tested else []))}
    whole = np.arange(len(scene.frames))
    return {"test": scene.splits["test"] if scene.split_source == "official" else whole}
