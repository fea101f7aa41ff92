"""Images of half and of double the size of a map's are located as well as those of its size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.camera import Camera
from lightning_pose.localization.image_sizes import MAX_ENLARGED_PIXELS, enlarge_image
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import stack_poses
from tests.rooms import MappedRoom


@pytest.fixture(scope="module")
def localizer(mapped_room: MappedRoom) -> Localizer:
    return Localizer.load(mapped_room.checkpoint)


def test_half_and_double_size(localizer: Localizer, mapped_room: MappedRoom) -> None:
    images = [mapped_room.read(i) for i in range(len(mapped_room.images))]
    error_m = {}
    for factor, filter_ in ((1.0, cv2.INTER_AREA), (0.5, cv2.INTER_AREA), (2.0, cv2.INTER_CUBIC)):
        resized = [cv2.resize(image, None, fx=factor, fy=factor, interpolation=filter_) for image in images]
        found_m = stack_poses(localizer.localize(resized))[0]
        error_m[factor] = np.median(np.linalg.norm(found_m - mapped_room.position_m, axis=1))
    assert error_m[1.0] < 0.03
    assert max(error_m.values()) < 2 * error_m[1.0]


def test_a_part_of_an_image_needs_its_camera(localizer: Localizer, mapped_room: MappedRoom) -> None:
    view = localizer.system.view
    assert view is not None
    parts = [mapped_room.read(i)[20:220, 40:280] for i in range(0, len(mapped_room.images), 3)]
    camera = f"PINHOLE,240,200,{view.fx},{view.fy},{view.cx - 40},{view.cy - 20}"
    found_m = stack_poses(localizer.localize(parts, camera=camera))[0]
    assert np.median(np.linalg.norm(found_m - mapped_room.position_m[::3], axis=1)) < 0.05
    with pytest.raises(
        ConfigError, match=r"240x200 pixels, and its camera is for 320x240.*give camera for its own size"
    ):
        localizer.localize(parts)


def test_an_enlarged_image_stays_small(localizer: Localizer) -> None:
    """Whatever focal length a stranger's camera has."""
    view = localizer.system.view
    assert view is not None
    image = np.zeros((3000, 4000), np.uint8)
    for focal in (1e-9, 1.0, 4000 * view.fx / view.width):
        camera = Camera.parse(f"PINHOLE,4000,3000,{focal},{focal},2000,1500")
        enlarged = enlarge_image(image, view, camera)
        assert image.size <= enlarged.size < 1.01 * MAX_ENLARGED_PIXELS
