"""ICL-NUIM: frames paired by number, poses reflected."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.formats.icl_nuim import reflect_poses
from lightning_pose.scenes.scene import Intrinsics
from tests.data.helpers import make_image

ROWS = ["1 0 0 -2.25 0 0 0 1", "2 1 2 3 0.5 0.5 0.5 0.5", "3 0 0 0 0 0 0 1"]


def write(root: Path, trajectory: str = "livingRoom2.gt.freiburg", images: int = 4) -> Path:
    for number in range(images):
        make_image(root / "rgb" / f"{number}.png")
    (root / trajectory).write_text("\n".join(ROWS) + "\n")
    return root


def test_reflection_is_s_t_s() -> None:
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (8, 1, 1))
    T[:, :3, :3] = Rotation.random(8, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(8, 3))
    S = np.diag([1.0, -1, 1, 1])
    expected = S @ T @ S
    quats = Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True)
    positions, reflected = reflect_poses(T[:, :3, 3], quats)
    np.testing.assert_allclose(positions, expected[:, :3, 3])
    np.testing.assert_allclose(
        Rotation.from_quat(reflected, scalar_first=True).as_matrix(), expected[:, :3, :3], atol=1e-12
    )


def test_frames_are_paired_by_number(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        scene = load_scene(write(tmp_path))
    assert "dropped 1 of 4 images" in caplog.text
    assert (scene.format, scene.ground_truth) == ("icl_nuim", "synthetic")
    assert [(f.index, f.image.name) for f in scene.frames] == [(1, "1.png"), (2, "2.png"), (3, "3.png")]
    frame = scene.frames[1]
    np.testing.assert_allclose(frame.position_m, [1, -2, 3])
    np.testing.assert_allclose(frame.quat_wxyz, [0.5, -0.5, 0.5, -0.5])
    assert frame.timestamp == pytest.approx(2 / 30)
    assert frame.intrinsics == Intrinsics(481.20, 480.0, 319.5, 239.5, size=(640, 480))


def test_image_list_is_used_where_there_is_one(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "associations.txt").write_text("1 depth/1.png 1 rgb/1.png\n2 depth/2.png 2 rgb/2.png\n")
    assert [f.index for f in load_scene(tmp_path, val_fraction=0).frames] == [1, 2]


def test_numbered_groundtruth_is_recognised_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path, "groundtruth.txt")
    (tmp_path / "rgb.txt").write_text("1 rgb/1.png\n2 rgb/2.png\n3 rgb/3.png\n")
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        assert load_scene(tmp_path).format == "icl_nuim"
    assert "if it is not, give format tum" in caplog.text
    forced = load_scene(tmp_path, format="tum")
    np.testing.assert_allclose(forced.frames[1].position_m, [1, 2, 3])


def test_names_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    make_image(write(tmp_path) / "rgb" / "first.png")
    with pytest.raises(DataError, match=r"first.png is not named by its frame's number; rename it"):
        load_scene(tmp_path)


def test_numbers_that_never_meet_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no image's number is in livingRoom2.gt.freiburg; name them"):
        load_scene(write(tmp_path, images=1))


def test_forced_without_a_trajectory(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no \*.gt.freiburg and no numbered groundtruth.txt; add one"):
        load_scene(tmp_path, format="icl_nuim")


@pytest.mark.parametrize(
    "line", ["{0} rgb/{0}.png {0} depth/{0}.png", "{0} depth/{0}.png {0} rgb/{0}.png", "{0} rgb/{0}.png"]
)
def test_colour_image_is_told_by_its_name(line: str, tmp_path: Path) -> None:
    write(tmp_path)
    for number in range(4):
        make_image(tmp_path / "depth" / f"{number}.png")
    (tmp_path / "associations.txt").write_text("\n".join(line.format(number) for number in (1, 2, 3)))
    assert [f.image.parent.name for f in load_scene(tmp_path).frames] == ["rgb"] * 3


def test_numbers_may_have_decimals(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path)
    (tmp_path / "livingRoom2.gt.freiburg").rename(tmp_path / "groundtruth.txt")
    path = tmp_path / "groundtruth.txt"
    path.write_text("".join(f"{row[0]}.000000{row[1:]}\n" for row in ROWS))
    assert load_scene(tmp_path).format == "icl_nuim"
    (tmp_path / "rgb.txt").write_text("".join(f"{number}.000000 rgb/{number}.png\n" for number in (1, 2, 3)))
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        assert load_scene(tmp_path).format == "tum"
    assert "counts frames: if it is ICL-NUIM, with y up in the world, give format icl_nuim" in caplog.text


def test_files_of_macos_are_no_images_and_no_trajectories(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "._livingRoom2.gt.freiburg").write_bytes(b"\0\5\x16\7")
    make_image(tmp_path / "rgb" / "._1.png")
    assert len(load_scene(tmp_path).frames) == 3


def test_bad_rows_are_dropped(tmp_path: Path) -> None:
    write(tmp_path, images=5)
    rows = [*ROWS, "4 0 0 0 nan 0 0 1", f"{'9' * 5000} 0 0 0 0 0 0 1", "50 0 0 0 0 0 0 0"]
    (tmp_path / "livingRoom2.gt.freiburg").write_text("\n".join(rows))
    with pytest.raises(DataError, match=r"1 of 4 frames cannot be used: .*gt.freiburg:4: expected"):
        load_scene(tmp_path)
    assert [f.index for f in load_scene(tmp_path, on_bad_frame="drop").frames] == [1, 2, 3]


def test_two_trajectories_are_refused(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "livingRoom1.gt.freiburg").write_text("\n".join(ROWS))
    with pytest.raises(DataError, match=r"2 trajectories, livingRoom1.gt.freiburg, livingRoom2.gt.freiburg; keep"):
        load_scene(tmp_path)
