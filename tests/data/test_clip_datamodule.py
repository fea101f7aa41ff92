"""ClipDataModule: scenes named apart, clips of one sequence, what training varies, and refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from lightning_pose.checkpoint import build_object
from lightning_pose.data import ClipDataModule
from lightning_pose.errors import ConfigError, DataError
from lightning_pose.features import ORB, SURF, Pixels
from lightning_pose.geometry.relative import relative_poses
from tests.helpers import Thumbnails, write_scene


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scenes") / "other", train=(9, 9), test=9)


def module(**settings: Any) -> ClipDataModule:
    return ClipDataModule(Thumbnails(), **{"clip_length": 4, **settings})


def sequences(data: ClipDataModule, split: str) -> list[set[str]]:
    """The sequences that each clip of a split touches."""
    clips = data.dataset(split)
    frames = clips.data.frame[clips.rows()]
    return [{data.scene.frames[i].sequence for i in row.tolist()} for row in frames]


def test_one_scene_on_its_own_splits(scene: Path) -> None:
    data = module(root=str(scene))
    assert data.scene.name == scene.name
    assert all(len(touched) == 1 for split in ("train", "val", "test") for touched in sequences(data, split))
    assert sequences(data, "test") == [{"seq-03"}] * 3
    frames = {split: set(data.dataset(split).data.frame.tolist()) for split in ("train", "val", "test")}
    assert not frames["train"] & frames["val"]
    assert not (frames["train"] | frames["val"]) & frames["test"]


def test_scenes_named_apart(scene: Path, other: Path) -> None:
    data = module(train_scenes=[str(scene)], test_scenes=[str(other)])
    assert data.scene.name == f"{scene.name} to other"
    assert data.scene.split_source == "unseen"
    assert {name for touched in sequences(data, "train") for name in touched} <= {
        f"{scene.name}/seq-0{i}" for i in (1, 2)
    }
    assert sequences(data, "test") == [{"other/seq-03"}] * 3


def test_batches_have_features_and_relative_poses(scene: Path) -> None:
    data = module(root=str(scene), batch_size=2, stride=2, clip_length=3)
    for batch in [*data.train_dataloader(), *data.test_dataloader()]:
        assert batch.features.shape == (len(batch.frame), 3, 6, 8)
        frames = [[data.scene.frames[i] for i in row] for row in batch.frame.tolist()]
        positions, quats = (
            torch.tensor([[getattr(frame, name).tolist() for frame in row] for row in frames])
            for name in ("position_m", "quat_wxyz")
        )
        expected = relative_poses(positions, quats)
        torch.testing.assert_close(batch.position_m, expected[0].double(), atol=1e-5, rtol=1e-5)
        assert (batch.frame.diff(dim=1) == 2).all()


def test_test_clips_are_fixed_and_training_clips_are_not(scene: Path) -> None:
    data = module(root=str(scene), val_fraction=0.0)
    test = [torch.cat([batch.frame for batch in data.test_dataloader()]) for _ in range(2)]
    assert torch.equal(*test)
    train = [torch.cat([batch.frame for batch in data.train_dataloader()])[:, 0].sort().values for _ in range(8)]
    assert any(not torch.equal(train[0], other) for other in train[1:])


def test_training_varies_as_it_is_set(scene: Path) -> None:
    data = module(root=str(scene), val_fraction=0.0, max_stride=3, reverse=True)
    strides = {int(row.diff()[0]) for _ in range(50) for batch in data.train_dataloader() for row in batch.frame}
    assert strides == {-3, -2, -1, 1, 2, 3}
    assert {int(row.diff()[0]) for batch in data.test_dataloader() for row in batch.frame} == {1}


def test_validation_comes_in_runs_as_long_as_a_clip(scene: Path) -> None:
    """Two sequences of twelve: halves are too short for a clip of eight, and a tenth is less than a sequence."""
    data = module(root=str(scene), clip_length=8)
    assert data.longest_clip("val") >= 8
    assert len(data.dataset("val")) > 0
    assert data.longest_clip("test") == 10


def test_clips_of_other_lengths(scene: Path) -> None:
    data = module(root=str(scene))
    assert data.clips("test", 10).rows().shape == (1, 10)
    assert data.clips("test", 2).rows().shape == (9, 2)
    assert data.clips("test", 2).data.features is data.dataset("test").data.features


def test_nothing_named_is_rooms(monkeypatch: pytest.MonkeyPatch, scene: Path, other: Path) -> None:
    rooms = {3: scene, 5: other}
    monkeypatch.setattr("lightning_pose.data.clip_datamodule.room_folder", lambda seed, frames: rooms[seed])
    data = module(train_rooms=[3], test_rooms=[5])
    assert data.scene.name == f"{scene.name} to other"


def test_its_description_rebuilds_it(scene: Path) -> None:
    data = module(root=str(scene), stride=2, mirror=False)
    spec = data.describe()
    spec["init_args"]["extractor"] = build_object(spec["init_args"]["extractor"], allow="tests")
    assert build_object(spec).describe() == data.describe()


@pytest.mark.parametrize("extractor", [SURF(5), SURF(5, with_geometry=True), Pixels(8, 8)])
def test_what_can_be_mirrored(extractor: Any, scene: Path) -> None:
    data = ClipDataModule(extractor, root=str(scene), mirror=True)
    assert data.mirror


@pytest.mark.parametrize(("extractor", "message"), [
    (ORB(5), "data.mirror is on, but orb features cannot be mirrored"),
    (SURF(5, upright=False), "SURF descriptors are oriented; set upright: true"),
])  # fmt: skip
def test_what_cannot_be_mirrored_is_refused(extractor: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ClipDataModule(extractor, mirror=True)


@pytest.mark.parametrize(("settings", "message"), [
    ({"clip_length": 1}, "clip_length is 1; give 2 frames or more"),
    ({"clip_length": 401}, "clip_length is 401; give 2 to 400 frames"),
    ({"relative_frame": "body"}, "relative_frame is 'body'"),
    ({"root": "a", "train_scenes": ["b"]}, "data.root is one scene, and"),
    ({"test_scenes": ["b"]}, "nothing to train on is named; give data.train_scenes"),
    ({"train_scenes": []}, "data.train_scenes is empty"),
    ({"batch_size": 0}, "data.batch_size is 0"),
])  # fmt: skip
def test_settings_that_contradict_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        module(**settings)


def test_clips_longer_than_a_sequence_are_refused(scene: Path) -> None:
    with pytest.raises(DataError, match=r"spans 40 frames, but the longest run of consecutive frames has \d+; give"):
        module(root=str(scene), clip_length=40, val_fraction=0.0).dataset("train")
