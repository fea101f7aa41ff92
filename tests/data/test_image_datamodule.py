"""ImageDataModule: splits, features and poses of a scene, in memory and in order."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lightning_pose.checkpoint import build_object
from lightning_pose.data import ImageDataModule, datamodule
from lightning_pose.errors import ConfigError, DataError, ImageError
from lightning_pose.features import ORB
from lightning_pose.scenes.images import read_gray
from tests.helpers import Thumbnails


def module(root: Path, **settings: Any) -> ImageDataModule:
    return ImageDataModule(Thumbnails(), root=str(root), **settings)


def test_the_shape_of_a_frame_needs_no_scene() -> None:
    assert ImageDataModule(Thumbnails(rows=3, columns=5), root="nowhere").input_shape == (3, 5)


def test_features_and_poses_belong_together(scene: Path) -> None:
    data = module(scene)
    data.prepare_data()
    for split in ("train", "val", "test"):
        batch = data.dataset(split).data
        assert batch.features.dtype == batch.quat_wxyz.dtype == torch.float32
        assert batch.position_m.dtype == torch.float64
        for row, index in enumerate(batch.frame.tolist()):
            frame = data.scene.frames[index]
            (record,) = data.extractor.extract([read_gray(frame.image)])
            np.testing.assert_array_equal(batch.features[row], record["thumbnail"])
            np.testing.assert_allclose(batch.position_m[row], frame.position_m, atol=1e-6)
            np.testing.assert_allclose(batch.quat_wxyz[row], frame.quat_wxyz, atol=1e-6)


def test_splits_are_disjoint_and_official(scene: Path) -> None:
    data = module(scene)
    frames = {split: data.dataset(split).data.frame.tolist() for split in ("train", "val", "test")}
    assert sorted(chain.from_iterable(frames.values())) == list(range(34))
    assert {data.scene.frames[i].sequence for i in frames["test"]} == {"seq-03"}
    assert frames["val"]


def test_loaders(scene: Path) -> None:
    data = module(scene, batch_size=5, eval_batch_size=4)
    train = list(data.train_dataloader())
    assert max(len(batch.frame) for batch in train) == 5
    assert sorted(torch.cat([batch.frame for batch in train]).tolist()) == data.dataset("train").data.frame.tolist()
    test = torch.cat([batch.frame for batch in data.test_dataloader()])
    assert test.tolist() == data.dataset("test").data.frame.tolist()
    assert torch.equal(test, torch.cat([batch.frame for batch in data.predict_dataloader()]))


def test_a_feature_pool_is_drawn_from_in_training_only(scene: Path) -> None:
    data = ImageDataModule(ORB(n_features=10), root=str(scene), feature_pool=4.0)
    strongest = ImageDataModule(ORB(n_features=40), root=str(scene)).dataset("train").data
    for batch in data.train_dataloader():
        assert batch.features.shape[1:] == data.input_shape == (10, 256)
        for frame, features in zip(batch.frame, batch.features, strict=True):
            pool = strongest.features[strongest.frame == frame][0]
            assert all((pool == row).all(dim=1).any() for row in features)
    torch.testing.assert_close(data.dataset("train").data.features, strongest.features[:, :10])


@pytest.mark.parametrize(("times", "rows"), [(1.0, 10), (1.5, 15), (100, 300)])
def test_a_feature_pool_grows_with_the_features_up_to_what_is_stored(times: float, rows: int, scene: Path) -> None:
    data = ImageDataModule(ORB(n_features=10), root=str(scene), feature_pool=times)
    assert data._pool is not None
    assert data._pool.n_features == rows


@pytest.mark.parametrize("times", [0.9, float("nan")])
def test_a_feature_pool_smaller_than_what_is_read_is_refused(times: float, scene: Path) -> None:
    with pytest.raises(ConfigError, match=rf"data.feature_pool is {times}; give how many times n_features it holds"):
        ImageDataModule(ORB(n_features=10), root=str(scene), feature_pool=times)


def test_a_feature_pool_needs_local_features(scene: Path) -> None:
    with pytest.raises(ConfigError, match=r"data.feature_pool needs local features, and thumbnails has none; leave"):
        module(scene, feature_pool=4.0)


def test_no_validation_frames_is_no_loader(scene: Path) -> None:
    data = module(scene, val_fraction=0.0)
    assert data.val_dataloader() == []
    assert len(data.dataset("train")) == 24


def test_no_test_frames_is_an_error(monkeypatch: pytest.MonkeyPatch, scene: Path) -> None:
    data = module(scene)
    without = replace(data.scene, splits={**data.scene.splits, "test": np.array([], int)})
    monkeypatch.setattr(ImageDataModule, "scene", without)
    with pytest.raises(DataError, match=f"{scene} has no test frames; give"):
        data.test_dataloader()


def test_without_a_folder_a_room_is_rendered(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scene: Path) -> None:
    asked: list[tuple[Any, ...]] = []

    def render(*args: object) -> Path:
        asked.append(args)
        return scene

    monkeypatch.setenv("LIGHTNING_POSE_CACHE", str(tmp_path))
    monkeypatch.setattr(datamodule, "render_room", render)
    data = ImageDataModule(Thumbnails(), room_seed=3, room_frames=50)
    assert asked == [], "not before it is needed"
    assert len(data.scene.frames) == 34
    ((folder, *room),) = asked
    assert room == [3, 50]
    assert folder.parent == tmp_path / "rooms"
    assert folder.name.startswith("room-3-50")


def test_a_description_rebuilds_it(scene: Path, tmp_path: Path) -> None:
    data = module(scene, batch_size=7, cache_dir=str(tmp_path))
    rebuilt = build_object(_built_extractor(data.describe()))
    assert rebuilt.describe() == data.describe()
    assert rebuilt.batch_size == 7
    assert rebuilt.cache.folder == data.cache.folder


def _built_extractor(spec: dict[str, Any]) -> dict[str, Any]:
    return {
        **spec,
        "init_args": {**spec["init_args"], "extractor": build_object(spec["init_args"]["extractor"], allow="tests")},
    }


def test_a_missing_image_is_named(scene: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(scene, tmp_path / "copy"))
    data = module(root)
    missing = data.scene.frames[4].image
    missing.unlink()
    with pytest.raises(ImageError, match=f"{missing} does not exist; check"):
        data.prepare_data()


@pytest.mark.parametrize("name", ["batch_size", "eval_batch_size"])
def test_sizes_out_of_range_are_refused(name: str, scene: Path) -> None:
    with pytest.raises(ConfigError, match=rf"data.{name} is 0; give 1 or more"):
        module(scene, **{name: 0})
