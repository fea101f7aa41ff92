"""The layout of ACE: images and poses belong together by order, cameras are a focal length or a matrix."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.scene import Intrinsics
from tests.data.helpers import QUARTER_TURN_Z


def write_frame(folder: Path, stem: str, x: float, calibration: str = "500\n") -> None:
    for part in ("rgb", "poses", "calibration"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "rgb" / f"{stem}.color.png"), np.zeros((40, 60), np.uint8))
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = QUARTER_TURN_Z
    T_world_cam[0, 3] = x
    np.savetxt(folder / "poses" / f"{stem}.pose.txt", T_world_cam)
    (folder / "calibration" / f"{stem}.calibration.txt").write_text(calibration)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "kitchen"
    for i in range(3):
        write_frame(root / "train", f"seq-01-frame-{i:06d}", i)
    write_frame(root / "train", "seq-02-frame-000000", 7, "100 0 30 0 110 20 0 0 1")
    write_frame(root / "test", "seq-03-frame-000004", 9)
    return root


def test_known_values(root: Path) -> None:
    scene = load_scene(root, val_fraction=0)
    assert (scene.format, scene.unit, scene.split_source) == ("ace", "m", "official")
    found = [(frame.sequence, frame.index, frame.position_m[0]) for frame in scene.frames]
    assert found == [
        (["test/seq-03", "-000004.color"][0], 4, 9),
        ("train/seq-01", 0, 0), ("train/seq-01", 1, 1), ("train/seq-01", 2, 2), ("train/seq-02", 0, 7),
    ]  # fmt: skip
    assert scene.splits["test"].tolist() == [0]
    np.testing.assert_allclose(scene.frames[1].quat_wxyz, [0.5**0.5, 0, 0, 0.5**0.5])
    assert scene.frames[1].intrinsics == Intrinsics(500, 500, 30, 20, (60, 40))
    assert scene.frames[4].intrinsics == Intrinsics(100, 110, 30, 20, (60, 40))


def test_without_calibration(root: Path) -> None:
    for split in ("train", "test"):
        for path in (root / split / "calibration").iterdir():
            path.unlink()
        (root / split / "calibration").rmdir()
    assert load_scene(root).frames[0].intrinsics is None


def test_as_many_poses_as_images(root: Path) -> None:
    (root / "train" / "poses" / "seq-01-frame-000001.pose.txt").unlink()
    with pytest.raises(DataError, match=r"train has 4 images in rgb and 3 files in poses"):
        load_scene(root)


def test_numbers_agree(root: Path) -> None:
    poses = root / "train" / "poses"
    (poses / "seq-01-frame-000001.pose.txt").rename(poses / "seq-01-frame-000009.pose.txt")
    with pytest.raises(DataError, match=r"000001.color.png and seq-01-frame-000002.pose.txt stand at the same place"):
        load_scene(root)


def test_faults(root: Path) -> None:
    (root / "train" / "poses" / "seq-01-frame-000001.pose.txt").write_text("nan " * 16)
    with pytest.raises(DataError, match=r"1 of 5 frames cannot be used: .*000001.pose.txt: the pose has NaN"):
        load_scene(root)
    (root / "train" / "calibration" / "seq-01-frame-000000.calibration.txt").write_text("f")
    with pytest.raises(DataError, match=r"calibration.txt: expected a focal length or a 3x3 camera matrix"):
        load_scene(root)
