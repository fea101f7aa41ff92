"""Several scenes joined into one: some to train on, some to validate on, some to test on."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes.scene import Frame, Scene

__all__ = ["check_one_world", "join_scenes"]

SHARED_WORLDS = ("tum", "icl_nuim")
"""Formats whose recordings of one place have one world: motion capture, and the renderer's."""

PLACES = {
    "tum": {"fr1": "freiburg1|fr1", "fr2": "freiburg2|fr2", "fr3": "freiburg3|fr3"},
    "icl_nuim": {"living room": "living|lr_?kt", "office": "office|of_?kt"},
}
"""Places of these formats, with what names of folders say so; a name that says nothing is taken for the same place."""


def check_one_world(scenes: Sequence[Scene]) -> None:
    """Refuse scenes whose absolute positions do not compare.

    Raises:
        ConfigError: a scene has a world of its own.
    """
    known = {scene.root.resolve(): scene for scene in scenes}
    if len(known) < 2:
        return
    formats = sorted({scene.format for scene in known.values()})
    own = [scene for scene in known.values() if scene.format not in SHARED_WORLDS or scene.unit != "m"]
    places = {place for scene in known.values() if (place := _find_place(scene))}
    if own:
        why = f"{own[0].format} gives each folder a world of its own, that of its reconstruction or renderer"
    elif len(formats) > 1:
        why = f"{' and '.join(formats)} were recorded in different places"
    elif len(places) > 1:
        why = f"{' and '.join(sorted(places))} are different places, each with its own origin"
    else:
        return
    raise ConfigError(
        f"absolute poses of {' and '.join(scene.name for scene in known.values())} do not compare: {why}. Give "
        "data.root, one folder with training and test sequences, or a system for clips, whose poses are relative"
    )


def _find_place(scene: Scene) -> str | None:
    """The place where a scene was recorded, by its folder's name and the one above; None if they do not say."""
    path = "/".join(scene.root.resolve().parts[-2:]).lower()
    for place, pattern in PLACES.get(scene.format, {}).items():
        if re.search(pattern, path):
            return place
    return None


def join_scenes(train: Sequence[Scene], test: Sequence[Scene], val: Sequence[Scene] = ()) -> Scene:
    """Join scenes into one whose training frames are of some of them and whose test frames are of others.

    Of a scene in `train` the training and validation frames are used, and the test frames if it is in `test` as well.
    Of a scene in `test` alone the official test split is used, or every frame if it has none, because no frame of it
    is trained on. Of a scene in `val` every frame is used that is not in an official test split. If there are several
    scenes, sequences are named `scene/sequence`.

    Args:
        train: scenes with splits, one or more.
        test: likewise; scenes of the same folder are one scene.
        val: further scenes to validate on.

    Returns:
        the joined scene. Its name holds both lists (`kitchen to office`) if they differ. Formats and ground truths that
        differ are joined with `+`, those of test scenes last.

    Raises:
        ConfigError: a scene to validate on is trained or tested on as well.
        DataError: the scenes' units differ.
    """
    known = {scene.root.resolve(): scene for scene in (*train, *test, *val)}
    trained, tested, validated = ({scene.root.resolve() for scene in part} for part in (train, test, val))
    for root in validated & (trained | tested):
        raise ConfigError(
            f"{root} is among data.val_scenes and is {'trained' if root in trained else 'tested'} on as well; "
            "validate on another, or leave data.val_scenes out"
        )
    units = {scene.unit for scene in known.values()}
    if len(units) > 1:
        named = ", ".join(f"{scene.name} in {scene.unit}" for scene in known.values())
        raise DataError(f"positions have different units ({named}); train and test on scenes of one unit")
    frames: list[Frame] = []
    splits: dict[str, list[np.ndarray]] = {"train": [], "val": [], "test": []}
    for root, scene in known.items():
        selected = _select_frames(scene, root in trained, root in tested, root in validated)
        for split, indices in selected.items():
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
        trajectory=train[0].trajectory if len(known) == 1 else None,  # times of recordings may overlap
    )


def _join_values(learned: Sequence[str], asked: Sequence[str]) -> str:
    """Each value once, joined with `+`; those of the test scenes last, because errors are measured there."""
    return "+".join(dict.fromkeys([*(value for value in learned if value not in asked), *asked]))


def _select_frames(scene: Scene, trained: bool, tested: bool, validated: bool) -> dict[str, np.ndarray]:
    """The scene's frames that go into each split."""
    if trained:
        return {split: scene.splits[split] for split in ("train", "val", *(["test"] if tested else []))}
    whole = np.arange(len(scene.frames))
    if validated:
        return {"val": np.setdiff1d(whole, scene.splits["test"]) if scene.split_source == "official" else whole}
    return {"test": scene.splits["test"] if scene.split_source == "official" else whole}
