"""The command export-map: with the images of the map, without them, and on systems that have no map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from lightning import Trainer

from lightning_pose.__main__ import main
from lightning_pose.data import ImageDataModule
from lightning_pose.features import SURF
from lightning_pose.models import LandmarkMap
from lightning_pose.scenes.synthetic import render_room
from tests.helpers import Trained


@dataclass(frozen=True)
class RoomMap:
    """A checkpoint with a map of a room, and the room's folder, whose images are all of one colour by now."""

    checkpoint: Path
    root: Path


@pytest.fixture(scope="module")
def room_map(tmp_path_factory: pytest.TempPathFactory) -> RoomMap:
    folder = tmp_path_factory.mktemp("map")
    root = render_room(folder / "room", frames=36, size=(160, 120))
    extractor = SURF(150, with_geometry=True)
    data = ImageDataModule(extractor, str(root), cache_dir=str(folder / "cache"))
    trainer = Trainer(
        max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(LandmarkMap(input_shape=[150, 68], bundle_adjust=False), datamodule=data)
    trainer.save_checkpoint(folder / "room.ckpt")
    for frame in data.scene.frames:
        cv2.imwrite(str(frame.image), np.full((120, 160, 3), [30, 20, 10], np.uint8))  # BGR
    return RoomMap(folder / "room.ckpt", root)


def test_a_map_has_the_names_cameras_and_colours_of_its_images(
    room_map: RoomMap, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export-map", str(room_map.checkpoint), str(tmp_path)]) == 0
    assert "points seen by 24 images" in capsys.readouterr().out
    points = np.loadtxt(tmp_path / "points.ply", skiprows=10)
    assert len(points) > 100
    assert (points[:, 3:] == [10, 20, 30]).all()
    assert " 1 seq-01/frame-000000.color.png\n" in (tmp_path / "images.txt").read_text()
    assert "PINHOLE 160 120 " in (tmp_path / "cameras.txt").read_text()


def test_a_map_whose_images_have_moved(room_map: RoomMap, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    moved = room_map.root.rename(room_map.root.parent / "moved")
    arguments = ["export-map", str(room_map.checkpoint), str(tmp_path)]
    assert main(arguments) == 0
    assert "the images are not to be found" in capsys.readouterr().out
    assert " 1 image-000000\n" in (tmp_path / "images.txt").read_text()
    assert main([*arguments, "--root", str(moved)]) == 0
    assert " 1 seq-01/frame-000000.color.png\n" in (tmp_path / "images.txt").read_text()
    moved.rename(room_map.root)


def test_another_scene_is_refused(
    room_map: RoomMap, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export-map", str(room_map.checkpoint), str(tmp_path), "--root", str(scene)]) == 2
    assert "is not the scene that the map was built of: its training frames have" in capsys.readouterr().err


def test_a_system_without_a_map_is_refused(
    trained: Trained, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export-map", str(trained.best), str(tmp_path / "out"), "--allow", "tests"]) == 2
    assert "holds a SurfLSTM without a map; give one of LandmarkMap, or of a system" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
