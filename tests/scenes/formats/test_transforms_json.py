"""`transforms.json`: OpenGL axes are turned, cameras are read for the file or each frame, splits are the file's."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.scene import Intrinsics
from tests.data.helpers import make_image

MATRIX = [[1.0, 0, 0, 4], [0, 1, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]]
CAMERA = {"fl_x": 500.0, "fl_y": 510.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480}


def write(root: Path, count: int = 4, name: str = "transforms.json", **settings: Any) -> Path:
    """A folder whose frame i is `images/i.png`."""
    for i in range(count):
        make_image(root / "images" / f"{i}.png")
    frames = [{"file_path": f"./images/{i}.png", "transform_matrix": MATRIX} for i in range(count)]
    (root / name).write_text(json.dumps({**CAMERA, "frames": frames, **settings}))
    return root


def test_known_values(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path / "fox", k1=0.1, k2=0.2, p1=0.3, p2=0.4))
    assert (scene.format, scene.unit, scene.ground_truth, scene.split_source) == (
        "transforms_json", "scene", "sfm", "blocks",
    )  # fmt: skip
    frame = scene.frames[2]
    assert (frame.image, frame.sequence, frame.index) == (tmp_path / "fox" / "images" / "2.png", "fox", 2)
    np.testing.assert_allclose(frame.position_m, [4, 5, 6])
    np.testing.assert_allclose(frame.quat_wxyz, [0, 1, 0, 0])  # y and z are reversed: half a turn about x
    assert frame.intrinsics == Intrinsics(500, 510, 319.5, 239.5, (640, 480), (0.1, 0.2, 0.3, 0.4))


def test_each_frame_may_have_a_camera(tmp_path: Path) -> None:
    frames = [{"file_path": f"images/{i}", "transform_matrix": MATRIX[:3], "fl_x": 100.0 + i} for i in range(3)]
    scene = load_scene(write(tmp_path, frames=frames, is_fisheye=True, k1=0.5))
    cameras = [frame.intrinsics for frame in scene.frames]
    assert [camera and camera.fx for camera in cameras] == [100, 101, 102]
    assert cameras[0] == Intrinsics(100, 510, 319.5, 239.5, (640, 480), (0.5, 0, 0, 0), fisheye=True)


def test_the_angle_of_view_gives_the_focal_length(tmp_path: Path) -> None:
    write(tmp_path)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": np.pi / 2, "frames": frames}))
    cv2.imwrite(str(tmp_path / "images" / "0.png"), np.zeros((40, 60), np.uint8))
    camera = load_scene(tmp_path).frames[3].intrinsics
    assert camera is not None
    assert (camera.cx, camera.cy, camera.size) == (29.5, 19.5, (60, 40))
    assert (camera.fx, camera.fy) == pytest.approx((30, 30))


def test_frames_without_an_image_are_dropped_with_a_count(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path, 6)
    (tmp_path / "images" / "3.png").unlink()
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        assert [frame.index for frame in load_scene(tmp_path).frames] == [0, 1, 2, 4, 5]
    assert "dropped 1 of 6 frames, their images are missing" in caplog.text


def test_images_beside_the_file(tmp_path: Path) -> None:
    write(tmp_path)
    for path in sorted((tmp_path / "images").iterdir()):
        path.rename(tmp_path / path.name)
    (tmp_path / "images").rmdir()
    assert load_scene(tmp_path).frames[1].image == tmp_path / "1.png"


def test_splits_that_the_file_names(tmp_path: Path) -> None:
    names = [f"images/{i}.png" for i in range(4)]
    scene = load_scene(
        write(tmp_path, train_filenames=names[:2], val_filenames=names[2:3], test_filenames=names[3:]), val_fraction=0
    )
    assert scene.split_source == "official"
    assert {split: rows.tolist() for split, rows in scene.splits.items()} == {
        "train": [0, 1, 2],
        "val": [],
        "test": [3],
    }


def test_one_file_a_split(tmp_path: Path) -> None:
    write(tmp_path, 4, "transforms_train.json")
    frames = [{"file_path": f"./images/{i}", "transform_matrix": MATRIX} for i in (8, 9)]
    for i in (8, 9):
        make_image(tmp_path / "images" / f"{i}.png")
    write(tmp_path, 4, "transforms_test.json", frames=frames)
    scene = load_scene(tmp_path, val_fraction=0)
    assert [scene.frames[i].index for i in scene.splits["test"]] == [8, 9]
    assert len(scene.splits["train"]) == 4


def test_a_folder_with_a_colmap_model_is_read_as_that(tmp_path: Path) -> None:
    write(tmp_path)
    for name in ("cameras.txt", "images.txt"):
        (tmp_path / name).touch()
    with pytest.raises(DataError, match=r"images.txt holds no photo"):
        load_scene(tmp_path)
    assert load_scene(tmp_path, format="transforms_json").format == "transforms_json"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"frames": []}, r"transforms.json lists no frame"),
        ({"frames": [{"file_path": "images/0.png"}]}, r"frame 0: expected file_path and a 4x4 transform_matrix"),
        ({"frames": [{"file_path": "images/0.png", "transform_matrix": [[1]]}]}, r"frame 0: expected .*\(1, 1\)"),
        ({"frames": 5}, r"transforms.json"),
        ({"fl_x": "long"}, r"frame 0: a number of the camera is no number"),
        ({"fl_x": -5.0}, r"focal lengths must be above 0"),
        ({"frames": [{"file_path": "x.png", "transform_matrix": MATRIX}]}, r"none of the 1 images .*x\.png"),
    ],
)
def test_faults(settings: dict[str, Any], message: str, tmp_path: Path) -> None:
    write(tmp_path, **settings)
    with pytest.raises(DataError, match=message):
        load_scene(tmp_path)


def test_no_json(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text("{")
    with pytest.raises(DataError, match=r"transforms.json is no transforms.json .*restore the original"):
        load_scene(tmp_path)


def test_a_pose_that_is_no_rotation_is_the_users_choice(tmp_path: Path) -> None:
    write(tmp_path, 5)
    content = json.loads((tmp_path / "transforms.json").read_text())
    content["frames"][1]["transform_matrix"] = (np.array(MATRIX) * [[2], [2], [2], [1]]).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"1 of 5 frames cannot be used: .*frame 1: the 3x3 is no rotation"):
        load_scene(tmp_path)
