"""Rules for test frames: known indices, and rules that cannot be followed."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes.formats import load_scene
from tests.data.helpers import write_seven_scenes


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_seven_scenes(tmp_path / "scene", train={1: 7, 2: 5}, test={3: 3})


def read_splits(root: Path, split: str, val_fraction: float = 0.0) -> dict[str, list[int]]:
    scene = load_scene(root, split=split, val_fraction=val_fraction)
    assert scene.split_source == split
    return {name: rows.tolist() for name, rows in scene.splits.items()}


def test_every_kth_frame_of_each_sequence(root: Path) -> None:
    splits = read_splits(root, "every_3")
    assert splits == {"train": [1, 2, 4, 5, 8, 9, 11, 13, 14], "val": [], "test": [0, 3, 6, 7, 10, 12]}


def test_validation_frames_are_held_out_of_the_rest(root: Path) -> None:
    splits = read_splits(root, "every_3", val_fraction=0.3)
    assert len(splits["val"]) > 0
    assert sorted(splits["train"] + splits["val"] + splits["test"]) == list(range(15))


def test_folders(root: Path) -> None:
    names = list(dict.fromkeys(frame.sequence for frame in load_scene(root).frames))
    assert read_splits(root, f"folders:{names[0]},{names[2]}")["test"] == [*range(7), 12, 13, 14]


def test_blocks_instead_of_the_official_split(root: Path) -> None:
    assert read_splits(root, "blocks")["test"] != [12, 13, 14]


def test_a_file(root: Path, tmp_path: Path) -> None:
    names = ["seq-01/frame-000000.color.png", "./seq-01/frame-000002.color.png", "seq-02/frame-000001.color.png"]
    lines = [f"{name} {split}" for name, split in zip(names, ("train", "val", "test"), strict=True)]
    file = tmp_path / "split.txt"
    file.write_text("# image split\n" + "\n".join(lines))
    assert read_splits(root, str(file), val_fraction=0.5) == {"train": [0], "val": [2], "test": [8]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seq-01/frame-000000.color.png", r"split.txt:1: expected `IMAGE train\|val\|test`"),
        ("nothing.png test", r"split.txt:1: nothing.png is the name of no image"),
        ("frame-000000.color.png test", r"is the name of several images"),
        ("seq-01/frame-000000.color.png train", r"leaves no test frame"),
    ],
)
def test_faults_of_a_file(text: str, message: str, root: Path, tmp_path: Path) -> None:
    (tmp_path / "split.txt").write_text(text)
    with pytest.raises(DataError, match=message):
        load_scene(root, split=str(tmp_path / "split.txt"))


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ("every", r"'every', which is no file and no rule; give blocks; every_K"),
        ("every_1", r"give every_2 or more"),
        ("folders:", r"no file and no rule"),
        ("folders:hall", r"names the folder 'hall'; .* has "),
    ],
)
def test_rules_that_cannot_be_followed(rule: str, message: str, root: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        load_scene(root, split=rule)


def test_a_rule_that_leaves_nothing_to_train_on(root: Path) -> None:
    names = ",".join(dict.fromkeys(frame.sequence for frame in load_scene(root).frames))
    with pytest.raises(DataError, match=r"leaves no train frame"):
        load_scene(root, split=f"folders:{names}")
