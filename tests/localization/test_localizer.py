"""Localizer: a checkpoint back to a thing that locates images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from mlflow import MlflowClient
from PIL import Image

from lightning_pose.checkpoint import read_checkpoint
from lightning_pose.errors import CheckpointError, ConfigError, ImageError
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import stack_poses
from lightning_pose.localization.trained_system import TrainedSystem
from lightning_pose.scenes.images import read_gray
from tests.helpers import Thumbnails, Trained


@pytest.fixture
def localizer(trained: Trained) -> Localizer:
    return Localizer.load(trained.best, allow="tests")


@pytest.fixture
def images(scene: Path) -> list[Path]:
    return sorted((scene / "seq-03").glob("*.png"))


def test_a_checkpoint_is_plain_and_whole(trained: Trained) -> None:
    checkpoint = read_checkpoint(trained.best)
    assert checkpoint["lightning_pose"]["model"]["init_args"]["input_shape"] == [6, 8]
    assert checkpoint["lightning_pose"]["data"]["init_args"]["root"] == str(trained.workplace.scene)


def test_it_locates_as_the_test_did(localizer: Localizer, images: list[Path], trained: Trained) -> None:
    position_m, quat_wxyz = stack_poses(localizer.localize(images))
    kept = trained.workplace.client.download_artifacts(trained.run.info.run_id, "trajectories/predictions/seq-03.tum")
    rows = np.loadtxt(kept)
    np.testing.assert_allclose(position_m, rows[:, 1:4], atol=1e-5)
    np.testing.assert_allclose(quat_wxyz, rows[:, [7, 4, 5, 6]], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(quat_wxyz, axis=1), 1, atol=1e-6)


def test_files_names_and_arrays_are_one(localizer: Localizer, images: list[Path]) -> None:
    from_files = stack_poses(localizer.localize(images[:2]))
    from_mixed = stack_poses(localizer.localize([str(images[0]), read_gray(images[1])]))
    for a, b in zip(from_files, from_mixed, strict=True):
        np.testing.assert_array_equal(a, b)


def test_it_does_not_learn(localizer: Localizer, images: list[Path]) -> None:
    assert isinstance(localizer.system, TrainedSystem)
    assert isinstance(localizer.system.extractor, Thumbnails)
    assert not localizer.system.model.training
    first, second = localizer.localize([images[0], images[0]])
    np.testing.assert_array_equal(first.position_m, second.position_m)


def test_an_image_that_is_missing(localizer: Localizer) -> None:
    with pytest.raises(ImageError, match=r"nowhere.png does not exist; check"):
        localizer.localize(["nowhere.png"])


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (None, r"images is None \(NoneType\); give an image file"),
        (7, r"images is 7 \(int\)"),
        ({"image": "a.png"}, r"images is {'image': 'a.png'} \(dict\)"),
        ([None], r"image 0 is None \(NoneType\)"),
        (np.zeros((4, 5), np.float32), r"shape \(4, 5\) and type float32; give uint8 of shape \(H, W\) gray"),
        ([np.zeros((4, 5, 4), np.uint8)], r"shape \(4, 5, 4\) and type uint8"),
        (np.zeros((0, 5), np.uint8), r"shape \(0, 5\)"),
    ],
)
def test_what_is_no_image_is_refused_in_one_line(localizer: Localizer, images: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        localizer.localize(images)  # pyright: ignore[reportCallIssue, reportArgumentType]


def test_folders_and_videos_are_refused(localizer: Localizer, tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"is a folder; give its images"):
        localizer.localize(tmp_path)
    (tmp_path / "walk.MP4").write_bytes(b"video")
    with pytest.raises(ImageError, match=r"walk.MP4 is a video among images"):
        localizer.localize([str(tmp_path / "walk.MP4")])


@pytest.mark.parametrize("content", [b"", b"garbage", b"PK\x03\x04 a broken archive"])
def test_a_file_that_is_no_checkpoint(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "some.ckpt"
    file.write_bytes(content)
    with pytest.raises(CheckpointError, match=f"{file} cannot be read as a checkpoint; it is damaged"):
        read_checkpoint(file)


def test_a_checkpoint_without_data(trained: Trained, tmp_path: Path) -> None:
    checkpoint = torch.load(trained.best, weights_only=True)
    checkpoint["lightning_pose"]["data"] = None
    torch.save(checkpoint, tmp_path / "model.ckpt")
    with pytest.raises(CheckpointError, match=r"model.ckpt does not say which features it reads; train with"):
        Localizer.load(tmp_path / "model.ckpt")


def test_one_image_may_stand_alone(localizer: Localizer, images: list[Path]) -> None:
    (expected,) = localizer.localize(images[:1])
    in_color = Image.open(images[0]).convert("RGB")
    for image in (
        images[0],
        str(images[0]),
        images[0].read_bytes(),
        read_gray(images[0]),
        in_color,
        np.asarray(in_color),
    ):
        pose = localizer.localize(image)
        np.testing.assert_array_equal(pose.position_m, expected.position_m)
        np.testing.assert_array_equal(pose.quat_wxyz, expected.quat_wxyz)
    with pytest.raises(ImageError, match=r"^the image is truncated or is not an image"):
        localizer.localize(b"a.png")
    with pytest.raises(ImageError, match=r"^a\.png does not exist"):
        localizer.localize("a.png")


def test_a_blank_image_is_refused(localizer: Localizer) -> None:
    rng = np.random.default_rng(0)
    dark = localizer.localize(rng.integers(0, 4, (48, 64)).astype(np.uint8))
    assert (dark.status, dark.reason, dark.source) == ("refused", "the image is blank", "network")
    assert np.isinf(dark.radius_m)
    assert localizer.localize(rng.integers(0, 255, (48, 64)).astype(np.uint8)).accepted


def test_no_image_has_no_pose(localizer: Localizer) -> None:
    assert localizer.localize([]) == []


def test_runs_and_registered_models(trained: Trained, images: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """A run by its id, its logged model, and a registered one by its alias give the checkpoint's poses."""
    workplace, run_id = trained.workplace, trained.run.info.run_id
    registered = f"wall-{run_id[:8]}"
    client = MlflowClient(workplace.uri, workplace.uri)
    client.create_registered_model(registered)
    client.create_model_version(registered, f"runs:/{run_id}/model", run_id)
    client.set_registered_model_alias(registered, "champion", "1")
    expected = Localizer.load(trained.best, allow="tests").localize(images[0])
    for source in (run_id, f"runs:/{run_id}/model", f"models:/{registered}@champion", f"models:/{registered}/1"):
        found = Localizer.load(source, allow="tests", tracking_uri=workplace.uri).localize(images[0])
        np.testing.assert_array_equal(found.position_m, expected.position_m)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", workplace.uri)
    assert Localizer.load(run_id, allow="tests").system.name == "SurfLSTM"
    with pytest.raises(ConfigError, match=rf"has no model models:/{registered}@loser .*; check the name"):
        Localizer.load(f"models:/{registered}@loser")
    with pytest.raises(ConfigError, match=r"has no model runs:/0{32}/model"):
        Localizer.load("0" * 32)


def test_what_cannot_be_loaded(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"nothing.ckpt does not exist; give a checkpoint such as"):
        Localizer.load("nothing.ckpt")
    with pytest.raises(ConfigError, match=r"is a folder without localizer.json"):
        Localizer.load(tmp_path)
