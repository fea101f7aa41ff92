"""Files of a map for other programs: read back by this project's COLMAP reader, and line by line."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.camera import Camera
from lightning_pose.mapping.camera_correction import CameraCorrection
from lightning_pose.mapping.model_files import Reconstruction, correct_camera, write_colmap_model, write_ply_files
from lightning_pose.scenes.formats import load_scene
from tests.mapping.helpers import make_walk

PINHOLE = Camera.parse("PINHOLE,64,48,50,51,31.5,23.5")
LENS = Camera.parse("OPENCV,128,96,100,100,63,47,-0.1,0.01,0.001,0.002")


@pytest.fixture(scope="module")
def model() -> Reconstruction:
    rotation, position = make_walk(6)
    points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 4], (20, 3))
    seen = np.array([(i, p) for i in range(6) for p in range(20) if (i + p) % 3])
    cameras = [PINHOLE, LENS] * 3
    colors = np.full((20, 3), [10, 20, 30], np.uint8)
    names = [f"walk/{i}.png" for i in range(6)]
    return Reconstruction(names, cameras, rotation, position, points, colors, *seen.T)


def test_poses_and_cameras_are_read_back(model: Reconstruction, tmp_path: Path) -> None:
    write_colmap_model(tmp_path / "sparse" / "0", model)
    (tmp_path / "images" / "walk").mkdir(parents=True)
    for name, camera in zip(model.names, model.cameras, strict=True):
        cv2.imwrite(str(tmp_path / "images" / name), np.zeros((camera.height, camera.width), np.uint8))
    scene = load_scene(tmp_path)
    assert scene.format == "colmap"
    frames = sorted(scene.frames, key=lambda frame: frame.image.name)
    np.testing.assert_allclose([frame.position_m for frame in frames], model.position, atol=1e-9)
    quats = Rotation.from_quat([frame.quat_wxyz for frame in frames], scalar_first=True)
    np.testing.assert_allclose(quats.as_matrix(), model.rotation, atol=1e-9)
    for frame, camera in zip(frames, model.cameras, strict=True):
        known = frame.intrinsics
        assert known is not None
        np.testing.assert_allclose(
            [known.fx, known.fy, known.cx, known.cy], [camera.fx, camera.fy, camera.cx, camera.cy]
        )
        assert known.size == (camera.width, camera.height)
        np.testing.assert_allclose(known.distortion, camera.distortion)


def test_observations_and_tracks_name_each_other(model: Reconstruction, tmp_path: Path) -> None:
    _, images, points = write_colmap_model(tmp_path, model)
    lines = [line for line in images.read_text().splitlines() if not line.startswith("#")]
    seen = [np.array(line.split(), float).reshape(-1, 3) for line in lines[1::2]]
    first = seen[0][0]  # of point 2 in the first image, by the pinhole camera
    local = (model.points[1] - model.position[0]) @ model.rotation[0]
    pixel = local[:2] / local[2] * [50, 51] + [31.5, 23.5]
    np.testing.assert_allclose(first, [*(pixel + 0.5), 2], atol=1e-4)
    for line in points.read_text().splitlines()[1:]:
        number, x, y, z, *rest = line.split()
        np.testing.assert_allclose([float(x), float(y), float(z)], model.points[int(number) - 1])
        assert rest[:4] == ["10", "20", "30", "-1"]
        track = np.array(rest[4:], int).reshape(-1, 2)
        assert len(track) == 4
        assert all(seen[image - 1][row, 2] == int(number) for image, row in track)


def test_ply_files_have_what_their_heads_say(model: Reconstruction, tmp_path: Path) -> None:
    points, cameras = write_ply_files(tmp_path, model)
    head, _, body = points.read_text().partition("end_header\n")
    assert "element vertex 20\n" in head
    rows = np.loadtxt(body.splitlines())
    np.testing.assert_allclose(rows[:, :3], model.points, rtol=1e-8)
    np.testing.assert_array_equal(rows[:, 3:], model.colors)
    lines = cameras.read_text().partition("end_header\n")[2].splitlines()
    assert len(lines) == 6 * (5 + 8)
    np.testing.assert_allclose(np.loadtxt(lines[: 6 * 5 : 5]), model.position, atol=1e-8)


def test_a_corrected_camera_shows_points_where_the_adjustment_does() -> None:
    correction = CameraCorrection(1.02, np.array([0.004, -0.003]), -0.05)
    rays = np.random.default_rng(1).uniform(-0.4, 0.4, (20, 2))
    expected = PINHOLE.project(correction.distort(rays))
    np.testing.assert_allclose(correct_camera(PINHOLE, correction).project(rays), expected, atol=1e-9)
    assert correct_camera(LENS, CameraCorrection()) == LENS
