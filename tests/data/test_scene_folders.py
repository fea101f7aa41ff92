"""Recordings named apart: which frames of which folder go into each split, other ground truths, and refusals."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lightning_pose.checkpoint import build_object
from lightning_pose.data import ClipDataModule, ImageDataModule
from lightning_pose.errors import ConfigError
from lightning_pose.scenes.scene import Frame
from tests.data.helpers import write_recording
from tests.helpers import Thumbnails, write_scene


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("tum")
    source = write_scene(folder / "source", train=(12, 10), test=8)
    names = ["rgbd_dataset_freiburg1_xyz", "rgbd_dataset_freiburg1_rpy", "rgbd_dataset_freiburg1_desk"]
    return [write_recording(folder / name, source, number) for number, name in enumerate(names, start=1)]


def module(**settings: Any) -> ImageDataModule:
    return ImageDataModule(Thumbnails(), **settings)


def rebuilt(data: ImageDataModule) -> ImageDataModule:
    spec = data.describe()
    spec["init_args"]["extractor"] = Thumbnails()
    return build_object(spec)


def folders(data: ImageDataModule, split: str) -> set[str]:
    frames: list[Frame] = [data.scene.frames[i] for i in data.scene.splits[split]]
    return {frame.image.parents[1].name.rpartition("_")[2] for frame in frames}


def test_images_train_on_one_recording_and_are_tested_on_another(recordings: list[str]) -> None:
    data = module(train_scenes=recordings[:1], test_scenes=recordings[1:2])
    assert data.scene.name == "rgbd_dataset_freiburg1_xyz to rgbd_dataset_freiburg1_rpy"
    assert data.scene.split_source == "unseen"
    assert folders(data, "train") == folders(data, "val") == {"xyz"}
    assert folders(data, "test") == {"rpy"}
    assert len(data.scene.splits["test"]) == 10, "every frame, because none is trained on"
    test = data.dataset("test").data
    frame = data.scene.frames[int(test.frame[3])]
    np.testing.assert_array_equal(test.position_m[3], frame.position_m)
    assert rebuilt(data).scene.name == data.scene.name


def test_validation_has_recordings_of_its_own(recordings: list[str]) -> None:
    data = module(train_scenes=recordings[:1], val_scenes=recordings[2:], test_scenes=recordings[1:2])
    assert {split: folders(data, split) for split in ("train", "val", "test")} == {
        "train": {"xyz"},
        "val": {"desk"},
        "test": {"rpy"},
    }
    # No frame of the recording to train on is held out.
    assert [len(data.scene.splits[split]) for split in ("train", "val", "test")] == [12, 8, 10]


def test_clips_have_them_as_well(recordings: list[str]) -> None:
    data = ClipDataModule(
        Thumbnails(),
        clip_length=4,
        train_scenes=recordings[:1],
        val_scenes=recordings[2:],
        test_scenes=recordings[1:2],
    )
    assert [len(data.scene.splits[split]) for split in ("train", "val", "test")] == [12, 8, 10]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"train": [0], "val": [0], "test": [1]}, "trained on as well"),
        ({"train": [0], "val": [1], "test": [1]}, "tested on as well"),
    ],
)
def test_validation_frames_are_used_for_nothing_else(
    recordings: list[str], names: dict[str, list[int]], message: str
) -> None:
    data = module(**{f"{split}_scenes": [recordings[i] for i in chosen] for split, chosen in names.items()})
    with pytest.raises(ConfigError, match=message):
        _ = data.scene


def test_recordings_in_different_worlds_are_refused_for_images(recordings: list[str], tmp_path: Path) -> None:
    kitchen, office = (str(write_scene(tmp_path / name, (6,), 4)) for name in ("kitchen", "office"))
    with pytest.raises(
        ConfigError, match="kitchen and office do not compare: 7scenes gives each folder a world of its"
    ):
        _ = module(train_scenes=[kitchen], test_scenes=[office]).scene
    assert module(train_scenes=[kitchen], test_scenes=[kitchen]).scene.name == "kitchen"
    assert ClipDataModule(Thumbnails(), train_scenes=[kitchen], test_scenes=[office], clip_length=3).scene.frames
    elsewhere = shutil.copytree(recordings[1], tmp_path / "rgbd_dataset_freiburg2_rpy")
    with pytest.raises(ConfigError, match="fr1 and fr2 are different places"):
        _ = module(train_scenes=recordings[:1], test_scenes=[str(elsewhere)]).scene


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"root": "a", "val_scenes": ["b"]}, "data.root is one scene"),
        ({"val_scenes": ["b"]}, "nothing to train on is named"),
        ({"train_scenes": ["a"], "test_scenes": []}, "data.test_scenes is empty"),
        ({"ground_truth": "sfm"}, "data.pgt"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(settings: dict[str, Any], message: str) -> None:
    for build in (module, lambda **more: ClipDataModule(Thumbnails(), **more)):
        with pytest.raises(ConfigError, match=message):
            build(**settings)


def test_another_ground_truth_is_part_of_the_scene_and_of_the_settings(tmp_path: Path) -> None:
    kitchen = str(write_scene(tmp_path / "kitchen", (6,), 4))
    data, other = module(root=kitchen), module(root=kitchen, ground_truth="registered")
    assert (data.scene.ground_truth, other.scene.ground_truth) == ("original", "registered")
    assert data.scene.splits["val"].tolist() == other.scene.splits["val"].tolist()
    moved = np.array([frame.position_m for frame in other.scene.frames])
    away = np.linalg.norm(moved - [frame.position_m for frame in data.scene.frames], axis=1)
    np.testing.assert_allclose(away, 0.02559, atol=1e-5)
    assert rebuilt(other).scene.ground_truth == "registered"
