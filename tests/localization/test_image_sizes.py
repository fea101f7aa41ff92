"""Images of half and of double the size of a map's are located as well as those of its size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from lightning import Trainer

from lightning_pose.data import ImageDataModule
from lightning_pose.errors import ConfigError
from lightning_pose.features import SURF
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import stack_poses
from lightning_pose.localization.trained_system import TrainedSystem
from lightning_pose.models import LandmarkMap
from lightning_pose.scenes.images import read_gray
from lightning_pose.scenes.synthetic import render_room


@pytest.fixture(scope="module")
def located(tmp_path_factory: pytest.TempPathFactory) -> tuple[Localizer, list[np.ndarray], np.ndarray]:
    """A map of a room, test images of it, and their positions."""
    folder = tmp_path_factory.mktemp("room")
    root = render_room(folder / "room", frames=45, size=(320, 240))
    extractor = SURF(200, with_geometry=True)
    data = ImageDataModule(extractor, str(root), val_fraction=0, cache_dir=str(folder / "cache"))
    model = LandmarkMap(input_shape=[200, 68], bundle_adjust=False)
    trainer = Trainer(
        max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(model, datamodule=data)
    frames = [data.scene.frames[i] for i in data.scene.splits["test"]]
    images = [read_gray(frame.image) for frame in frames]
    return Localizer(TrainedSystem(extractor, model)), images, np.array([frame.position_m for frame in frames])


def test_half_and_double_size(located: tuple[Localizer, list[np.ndarray], np.ndarray]) -> None:
    localizer, images, truth_m = located
    error_m = {}
    for factor, filter_ in ((1.0, cv2.INTER_AREA), (0.5, cv2.INTER_AREA), (2.0, cv2.INTER_CUBIC)):
        resized = [cv2.resize(image, None, fx=factor, fy=factor, interpolation=filter_) for image in images]
        error_m[factor] = np.median(np.linalg.norm(stack_poses(localizer.localize(resized))[0] - truth_m, axis=1))
    assert error_m[1.0] < 0.03
    assert max(error_m.values()) < 2 * error_m[1.0]


def test_a_part_of_an_image_needs_its_camera(located: tuple[Localizer, list[np.ndarray], np.ndarray]) -> None:
    localizer, images, truth_m = located
    view = localizer.system.view
    assert view is not None
    parts = [image[20:220, 40:280] for image in images]
    camera = f"PINHOLE,240,200,{view.fx},{view.fy},{view.cx - 40},{view.cy - 20}"
    assert np.median(np.linalg.norm(stack_poses(localizer.localize(parts, camera=camera))[0] - truth_m, axis=1)) < 0.05
    with pytest.raises(
        ConfigError, match=r"240x200 pixels, and its camera is for 320x240.*give camera for its own size"
    ):
        localizer.localize(parts)
