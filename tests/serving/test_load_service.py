"""A checkpoint with a map as a service: what it says of itself, its map from above, and answers over HTTP."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from lightning import Trainer

from lightning_pose.__main__ import main
from lightning_pose.data import ImageDataModule
from lightning_pose.errors import ConfigError
from lightning_pose.features import SURF
from lightning_pose.localization.localizer import Localizer
from lightning_pose.models import LandmarkMap
from lightning_pose.scenes.scene import Frame
from lightning_pose.scenes.synthetic import render_room
from lightning_pose.serving.load_service import load_service
from lightning_pose.serving.service import Service
from lightning_pose.serving.uploads import Upload
from tests.serving.helpers import serve


class Room(NamedTuple):
    """A map of a room, and a test frame of it."""

    checkpoint: Path
    frame: Frame


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    folder = tmp_path_factory.mktemp("room")
    root = render_room(folder / "hall", frames=36, size=(160, 120))
    data = ImageDataModule(SURF(150, with_geometry=True), str(root), cache_dir=str(folder / "cache"))
    trainer = Trainer(
        max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(LandmarkMap(input_shape=[150, 68], bundle_adjust=False), datamodule=data)
    trainer.save_checkpoint(folder / "hall.ckpt")
    return Room(folder / "hall.ckpt", data.scene.frames[data.scene.splits["test"][2]])


@pytest.fixture(scope="module")
def service(room: Room) -> Service:
    return load_service(room.checkpoint)


def test_it_says_what_it_is(service: Service) -> None:
    facts = dict(service.model)
    assert str(facts.pop("camera")).startswith("PINHOLE,160,120,")
    assert facts.pop("version")
    assert facts == {
        "architecture": "LandmarkMap",
        "reads": "gray",
        "scene": "hall",
        "ground_truth": "original",
        "features": "SURF",
    }


def test_the_map_lies_around_its_cameras(service: Service, room: Room) -> None:
    assert service.view is not None
    cameras, box = np.array(service.view["cameras"]), np.array(service.view["box"])
    assert len(cameras) == 24
    assert ((box[:2] < cameras[:, :2]) & (cameras[:, :2] < box[2:])).all()
    assert np.abs(np.array(service.view["axes"])[:, 2]).max() < 0.3  # the room's z is up
    place = np.array(service.view["axes"]) @ room.frame.position_m
    assert np.linalg.norm(cameras[:, :2] - place, axis=1).min() < 1.5


def test_answers_are_the_localizer_s(service: Service, room: Room) -> None:
    image = room.frame.image.read_bytes()
    expected = Localizer.load(room.checkpoint).localize(image)
    camera = str(service.model["camera"])
    prior = ",".join(map(str, [*expected.position_m, *expected.quat_wxyz]))
    with serve(service) as server:
        alone, given = server.post(image), server.post_form(image, camera=camera, prior=prior)
        assert server.ask("GET", "/map").json == service.view
        for setting in ({"camera": "LENS,1,2,3"}, {"camera": "PINHOLE,100,100,90,90,50,50"}, {"prior": "here"}):
            refused = server.post(image, **setting)
            assert (refused.status, refused.code) == (422, "unusable")
    for answer in (alone, given):
        assert answer.status == 200
        assert answer.json["status"] == expected.status
    np.testing.assert_allclose(alone.json["position_m"], expected.position_m)
    assert alone.json["inliers"] == expected.inliers


def test_an_exported_folder_is_served_as_its_checkpoint(service: Service, room: Room, tmp_path: Path) -> None:
    assert main(["export", str(room.checkpoint), "--out", str(tmp_path / "hall")]) == 0
    exported = load_service(tmp_path / "hall")
    for name in ("architecture", "camera", "reads", "ground_truth", "version"):
        assert exported.model[name] == service.model[name]
    assert exported.view is not None
    assert service.view is not None
    for name in ("points", "cameras", "box"):
        np.testing.assert_allclose(np.array(exported.view[name]), np.array(service.view[name]), atol=1e-3)
    upload = Upload(room.frame.image.read_bytes(), "a.png")
    answer, expected = exported.locate(upload), service.locate(upload)
    np.testing.assert_allclose(np.array(answer["position_m"]), np.array(expected["position_m"]), atol=1e-3)
    assert answer["image"] == "a.png"


def test_systems_for_clips_are_refused(monkeypatch: pytest.MonkeyPatch, room: Room) -> None:
    from lightning_pose.localization.trained_system import TrainedSystem

    class Clips(TrainedSystem):
        def __init__(self, *args: object, **kwargs: object) -> None:
            super().__init__(*args, **kwargs)  # type: ignore[arg-type]
            self.clips = (4, "camera")

    monkeypatch.setattr("lightning_pose.localization.trained_system.TrainedSystem", Clips)
    with pytest.raises(ConfigError, match="which locates videos; serve answers single images: locate videos with"):
        load_service(room.checkpoint)
