"""KITTI odometry: poses of camera 0 are moved to the camera that is read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.scene import Intrinsics
from tests.data.helpers import make_image

CALIBRATION = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP2: 700 0 600 42 0 700 180 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A drive along z, turned half a circle about y; camera 2 stands 6 cm right of where camera 0 would be."""
    root = tmp_path / "sequences" / "03"
    for i in range(5):
        make_image(root / "image_2" / f"{i:06d}.png")
    (root / "calib.txt").write_text(CALIBRATION)
    (root / "times.txt").write_text("".join(f"{i * 0.1:e}\n" for i in range(5)))
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "03.txt").write_text("".join(f"-1 0 0 0 0 1 0 0 0 0 -1 {i}\n" for i in range(5)))
    return root


def test_known_values(root: Path) -> None:
    scene = load_scene(root)
    assert (scene.name, scene.format, len(scene.frames)) == ("03", "kitti", 5)
    frame = scene.frames[3]
    # x_2 = x_0 + 0.06, so that camera 2 is at x_0 = -0.06, which half a turn about y makes +0.06
    np.testing.assert_allclose(frame.position_m, [0.06, 0, 3])
    np.testing.assert_allclose(frame.quat_wxyz, [0, 0, 1, 0], atol=1e-12)
    assert (frame.sequence, frame.index, frame.timestamp) == ("03", 3, pytest.approx(0.3))
    assert frame.intrinsics == Intrinsics(700, 700, 600, 180)


def test_the_gray_camera_and_poses_in_the_folder(root: Path) -> None:
    (root / "image_2").rename(root / "image_0")
    (root.parent.parent / "poses" / "03.txt").rename(root / "poses.txt")
    np.testing.assert_allclose(load_scene(root).frames[3].position_m, [0, 0, 3])


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("calib.txt", "P0: 1\n", r"calib.txt has no line `P2:`"),
        ("calib.txt", "P2: 1 2\n", r"calib.txt:1: expected 12 numbers"),
        ("times.txt", "now\n", r"times.txt: expected one number of seconds"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", r"poses.txt has 1 poses for 5 images"),
        ("poses.txt", "1 0 0 0\n" * 5, r"5 of 5 frames|no usable frame"),
    ],
)
def test_faults(file: str, text: str, message: str, root: Path) -> None:
    (root / file).write_text(text)
    with pytest.raises(DataError, match=message):
        load_scene(root)
