"""EXIF: images that are stored turned, and focal lengths where the camera is another one than the map's."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.camera import Camera
from lightning_pose.localization.exif import FILM_DIAGONAL_MM, turn_camera
from lightning_pose.localization.inputs import LoadedImage
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import LocatedPose
from lightning_pose.localization.trained_system import TrainedSystem
from tests.rooms import MappedRoom

QUARTERS = {3: 2, 6: 1, 8: 3}


@pytest.fixture(scope="module")
def localizer(mapped_room: MappedRoom) -> Localizer:
    return Localizer.load(mapped_room.checkpoint)


def save_photo(path: Path, pixels: np.ndarray, orientation: int = 1, focal_35mm: int | None = None) -> Path:
    """Write a PNG with EXIF."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    if focal_35mm is not None:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    Image.fromarray(pixels).save(path, exif=exif)
    return path


@pytest.mark.parametrize("orientation", QUARTERS)
def test_a_photo_that_is_stored_turned(
    orientation: int, localizer: Localizer, mapped_room: MappedRoom, tmp_path: Path
) -> None:
    quarters = QUARTERS[orientation]
    upright = localizer.localize(mapped_room.images[3])
    stored = np.ascontiguousarray(np.rot90(mapped_room.read(3), quarters))  # counterclockwise
    pose = localizer.localize(save_photo(tmp_path / "turned.png", stored, orientation))
    assert pose.status == "accepted"
    np.testing.assert_allclose(pose.position_m, upright.position_m, atol=1e-6)
    assert f"EXIF orientation {orientation}" in pose.notes[0]
    # What is to the right in the upright image is, in the stored pixels, where a clockwise turn would bring it from.
    right = {1: [0, -1, 0], 2: [-1, 0, 0], 3: [0, 1, 0]}[quarters]
    np.testing.assert_allclose(pose.T_world_cam[:3, :3] @ right, upright.T_world_cam[:3, :3] @ [1, 0, 0], atol=1e-6)
    assert pose.inliers_px is not None
    assert upright.inliers_px is not None
    height, width = mapped_room.read(3).shape[:2]
    x, y = upright.inliers_px.T
    moved = {1: (y, width - 1 - x), 2: (width - 1 - x, height - 1 - y), 3: (height - 1 - y, x)}[quarters]
    np.testing.assert_allclose(pose.inliers_px, np.stack(moved, axis=1), atol=1e-3)


def test_a_photo_whose_orientation_does_not_fit_is_located_as_stored(
    localizer: Localizer, mapped_room: MappedRoom, tmp_path: Path
) -> None:
    pose = localizer.localize(save_photo(tmp_path / "wrong.png", mapped_room.read(3), 3))
    expected = localizer.localize(mapped_room.images[3])
    np.testing.assert_array_equal(pose.quat_wxyz, expected.quat_wxyz)
    assert pose.notes == ("EXIF orientation 3 is not applied",)


class Landscapes(TrainedSystem):
    """A network whose training images are wider than high, as its radii say; its poses are the identity."""

    name, color, view, clips = "Landscapes", "gray", None, None  # type: ignore[assignment]

    def __init__(self, knows_radius: bool = True) -> None:
        self.knows_radius = knows_radius

    def locate(self, image: LoadedImage, camera: Camera | None = None, prior: CameraPose | None = None) -> LocatedPose:
        radius_m = (0.1 if image.size[0] > image.size[1] else 0.5) if self.knows_radius else np.nan
        return LocatedPose(np.zeros(3), np.array([1.0, 0, 0, 0]), radius_m=radius_m)


@pytest.mark.parametrize(
    ("size", "knows_radius", "turned"), [((48, 64), True, True), ((64, 48), True, False), ((48, 64), False, False)]
)
def test_a_network_gets_the_nearer_of_both(
    size: tuple[int, int], knows_radius: bool, turned: bool, tmp_path: Path
) -> None:
    stored = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3)).astype(np.uint8)
    pose = Localizer(Landscapes(knows_radius)).localize(save_photo(tmp_path / "a.png", stored, 6))
    if turned:
        np.testing.assert_allclose(pose.quat_wxyz, [0.5**0.5, 0, 0, 0.5**0.5])
        assert pose.notes[0].startswith("turned upright by EXIF orientation 6")
    else:
        assert pose.notes == ("EXIF orientation 6 is not applied",)


def test_the_focal_length_of_another_camera(localizer: Localizer, mapped_room: MappedRoom, tmp_path: Path) -> None:
    view = localizer.system.view
    assert view is not None
    wide = mapped_room.read(5)[30:210]  # 16:9
    focal_mm = view.fx * FILM_DIAGONAL_MM / np.hypot(320, 180)
    pose = localizer.localize(save_photo(tmp_path / "wide.png", wide, focal_35mm=round(focal_mm)))
    assert pose.status == "accepted"
    assert np.linalg.norm(pose.position_m - mapped_room.position_m[5]) < 0.1
    assert pose.notes[0].startswith(f"camera from EXIF: {round(focal_mm)} mm on film")
    with pytest.raises(ConfigError, match="its camera is for 320x240"):
        localizer.localize(save_photo(tmp_path / "unknown.png", wide))


@pytest.mark.parametrize(("factor", "noted"), [(1.05, False), (2.0, True)])
def test_the_same_shape_with_another_lens(
    factor: float, noted: bool, localizer: Localizer, mapped_room: MappedRoom, tmp_path: Path
) -> None:
    view = localizer.system.view
    assert view is not None
    image = mapped_room.read(5)
    if noted:  # the middle, enlarged, as a lens of twice the focal length sees it
        image = cv2.resize(image[60:180, 80:240], (320, 240), interpolation=cv2.INTER_CUBIC)
    focal_mm = factor * view.focal_px * FILM_DIAGONAL_MM / np.hypot(320, 240)
    pose = localizer.localize(save_photo(tmp_path / "lens.png", image, focal_35mm=round(focal_mm)))
    assert bool(pose.notes) == noted
    assert pose.status == "accepted"
    assert np.linalg.norm(pose.position_m - mapped_room.position_m[5]) < 0.2


def test_a_turned_camera_projects_to_turned_pixels() -> None:
    camera = Camera.parse("OPENCV,640,480,500,510,300,200,0.1,-0.05,0.01,0.02")
    points = np.array([[0.1, -0.2], [0.3, 0.25]])
    x, y = camera.project(points).T
    turned_points = np.stack([-points[:, 1], points[:, 0]], axis=1)
    np.testing.assert_allclose(turn_camera(camera, 1).project(turned_points), np.stack([479 - y, x], axis=1), atol=1e-9)
    assert turn_camera(camera, 4) == camera


def test_a_damaged_exif_block_says_nothing(localizer: Localizer, mapped_room: MappedRoom, tmp_path: Path) -> None:
    Image.fromarray(mapped_room.read(2)).save(tmp_path / "a.jpg", exif=b"Exif\0\0II*\0\xff\xff\xff\xff", quality=98)
    pose = localizer.localize(tmp_path / "a.jpg")
    assert (pose.status, pose.notes) == ("accepted", ())
