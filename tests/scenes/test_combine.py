"""Several scenes as one: which frames go into which split."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.combine import join_scenes
from lightning_pose.scenes.scene import Frame, Scene


def scene(name: str, official: bool = True) -> Scene:
    """Ten frames in two sequences: five to train, one to validate, four to test."""
    frames = [Frame(Path(f"{name}/{i}"), np.zeros(3), np.eye(4)[0], f"seq-{i // 5}", i) for i in range(10)]
    splits = {"train": np.arange(5), "val": np.array([5]), "test": np.arange(6, 10)}
    return Scene(name, Path(name), "tum", tuple(frames), splits, "official" if official else "blocks")


def images(joint: Scene, split: str) -> list[str]:
    return [str(joint.frames[i].image) for i in joint.splits[split]]


def test_one_scene_stays_as_it_is() -> None:
    joint = join_scenes([scene("a")], [scene("a")])
    assert joint.name == "a"
    assert joint.split_source == "official"
    assert {frame.sequence for frame in joint.frames} == {"seq-0", "seq-1"}
    assert {split: len(part) for split, part in joint.splits.items()} == {"train": 5, "val": 1, "test": 4}


def test_unseen_scenes_are_tested_on_their_official_split_or_as_a_whole() -> None:
    joint = join_scenes([scene("a")], [scene("b"), scene("c", official=False)])
    assert joint.name == "a to b+c"
    assert joint.split_source == "unseen"
    assert images(joint, "train") == [f"a/{i}" for i in range(5)]
    assert images(joint, "test") == [f"b/{i}" for i in range(6, 10)] + [f"c/{i}" for i in range(10)]
    assert {frame.sequence for frame in joint.frames} == {f"{s}/seq-{i}" for s in "abc" for i in range(2)}


def test_what_is_trained_on_is_never_tested_on() -> None:
    joint = join_scenes([scene("a"), scene("b")], [scene("b"), scene("c", official=False)])
    assert joint.split_source == "official", "one of the tested scenes has been seen"
    assert not set(images(joint, "train") + images(joint, "val")) & set(images(joint, "test"))
    swapped = join_scenes([scene("c", official=False), scene("b")], [scene("b")])
    assert swapped.split_source == "official", "that of the scene tested on"
    assert images(joint, "val") == ["a/5", "b/5"]
    assert [name for name in images(joint, "test") if name.startswith("b")] == [f"b/{i}" for i in range(6, 10)]


def test_what_is_tested_is_named_last() -> None:
    """The format and ground truth that errors are measured by come last."""
    room, chess = (
        replace(scene("room"), ground_truth="synthetic"),
        replace(scene("chess"), format="7scenes", ground_truth="original"),
    )
    heads = replace(chess, name="heads", root=Path("heads"))
    for train, formats, truths in (
        ([room], "tum+7scenes", "synthetic+original"),
        ([chess, room], "tum+7scenes", "synthetic+original"),
        ([chess], "7scenes", "original"),
    ):
        joint = join_scenes(train, [heads])
        assert (joint.format, joint.ground_truth) == (formats, truths)


def test_units_do_not_mix() -> None:
    with pytest.raises(DataError, match=r"different units \(a in m, b in scene\)"):
        join_scenes([scene("a")], [replace(scene("b"), unit="scene")])
