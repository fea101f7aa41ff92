"""EuRoC: body poses are interpolated at the images' times and moved to the camera."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.scene import Intrinsics
from tests.data.helpers import make_image

START = 1403636579763555584
STEP = 50_000_000
SENSOR = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.5,
         1.0, 0.0, 0.0, 0.0,
         0.0, 0.0, 1.0, 0.0,
         0.0, 0.0, 0.0, 1.0]
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.76e-05]
"""
HEADER = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The body moves along x by 1 m a second; images are half a step after the poses."""
    root = tmp_path / "V1_01_easy"
    folder = root / "mav0"
    (folder / "state_groundtruth_estimate0").mkdir(parents=True)
    (folder / "cam0" / "data").mkdir(parents=True)
    stamps = [START + STEP // 2 + i * STEP for i in range(6)]
    for stamp in stamps:
        make_image(folder / "cam0" / "data" / f"{stamp}.png")
    lines = "".join(f"{stamp},{stamp}.png\r\n" for stamp in stamps)
    (folder / "cam0" / "data.csv").write_text(f"#timestamp [ns],filename\r\n{lines}")
    (folder / "cam0" / "sensor.yaml").write_text(SENSOR)
    poses = "".join(f"{START + i * STEP},{i * 0.05},0,0,1,0,0,0,0,0,0\n" for i in range(6))
    (folder / "state_groundtruth_estimate0" / "data.csv").write_text(
        HEADER.replace("\n", ", v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]\n") + poses
    )
    return root


def test_known_values(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        scene = load_scene(root, val_fraction=0)
    assert "dropped 1 of 6 images, no pose at their time" in caplog.text  # the last is after the last pose
    assert (scene.name, scene.format, scene.unit, len(scene.frames)) == ("V1_01_easy", "euroc", "m", 5)
    frame = scene.frames[2]
    np.testing.assert_allclose(frame.position_m, [0.5 + 0.125, 0, 0], atol=1e-6)
    np.testing.assert_allclose(frame.quat_wxyz, [0.5**0.5, 0, 0, 0.5**0.5])
    assert frame.timestamp == pytest.approx((START + 2.5 * STEP) / 1e9)
    lens = (-0.28, 0.07, 0.0002, 1.76e-05)
    assert frame.intrinsics == Intrinsics(458.654, 457.296, 367.215, 248.375, (752, 480), lens)


def test_the_folder_mav0(root: Path) -> None:
    assert load_scene(root / "mav0").frames[0].sequence == "V1_01_easy"


def test_images_in_a_hole_of_the_poses_are_dropped(root: Path) -> None:
    path = root / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], *lines[4:]]))
    assert [frame.index for frame in load_scene(root, val_fraction=0).frames] == [3, 4]


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cam0/sensor.yaml", "T_BS", "T", r"sensor.yaml has no T_BS, intrinsics and resolution"),
        ("cam0/sensor.yaml", "[458.654, ", "[", r"sensor.yaml has no T_BS, intrinsics and resolution"),
        ("cam0/data.csv", f"{START + STEP // 2},", "now,", r"data.csv:2: expected `nanoseconds,file`"),
        ("state_groundtruth_estimate0/data.csv", str(START)[:6], "999999", r"no image lies within the times"),
    ],
)
def test_faults(file: str, old: str, new: str, message: str, root: Path) -> None:
    path = root / "mav0" / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DataError, match=message):
        load_scene(root)
