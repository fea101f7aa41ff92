"""TUM RGB-D: association by time, and xyzw."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.formats.tum import pair_by_time
from lightning_pose.scenes.scene import Intrinsics
from tests.data.helpers import REAL_DATA, make_image

OFFICE = REAL_DATA / "tum" / "hololens_office"


def write(root: Path, image_times: list[float], rows: list[str]) -> Path:
    paths = [f"rgb/{time:.6f}.png" for time in image_times]
    for path in paths:
        make_image(root / path)
    lines = [f"{time:.6f} {path}\n" for time, path in zip(image_times, paths, strict=True)]
    (root / "rgb.txt").write_text("# color images\n# timestamp filename\n" + "".join(lines))
    (root / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")
    return root


@pytest.mark.parametrize(
    ("name", "fx"),
    [("fr1_rpy", 517.3), ("fr2-desk", 520.9), ("rgbd_dataset_freiburg3_office", 535.4), ("fr10", None), ("afr1", None)],
)
def test_the_folder_names_the_camera(name: str, fx: float | None, tmp_path: Path) -> None:
    scene = load_scene(
        write(tmp_path / name, [100.0, 100.1, 100.2], [f"{t} 0 0 0 0 0 0 1" for t in (100.0, 100.1, 100.2)])
    )
    intrinsics = scene.frames[0].intrinsics
    assert (intrinsics and intrinsics.fx) == fx


def test_pose_and_order_of_the_quaternion(tmp_path: Path) -> None:
    root = tmp_path / "rgbd_dataset_freiburg1_desk"
    rows = ["100.1 4 5 6 0 0 0 1", "100.004 1 2 3 0.1 0.1 0.7 0.7", "100.2 0 0 0 0 0 0 -1"]
    scene = load_scene(write(root, [100.1, 100.0, 100.2], rows))
    frame = scene.frames[0]
    np.testing.assert_allclose(frame.position_m, [1, 2, 3])
    np.testing.assert_allclose(frame.quat_wxyz, [0.7, 0.7 / 7, 0.7 / 7, 0.7])
    assert (frame.sequence, frame.index, frame.timestamp) == (root.name, 0, 100.0)
    assert frame.intrinsics == Intrinsics(
        517.3, 516.5, 318.6, 255.3, (640, 480), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    )
    np.testing.assert_allclose([f.quat_wxyz[0] for f in scene.frames[1:]], 1)
    assert (scene.name, scene.format) == (root.name, "tum")


def test_association_is_one_to_one_closest_first() -> None:
    """Image 0 and 1 both want pose 0; image 1 is closer, and image 0 then finds nothing within 20 ms."""
    pairs = pair_by_time(np.array([0.0, 0.015, 1.0, 2.0]), np.array([0.014, 0.990, 1.005, 2.021]))
    np.testing.assert_array_equal(pairs, [[1, 0], [2, 2]])


def test_second_choice_is_taken_when_the_first_is_gone() -> None:
    pairs = pair_by_time(np.array([0.000, 0.010]), np.array([0.008, -0.015]))
    np.testing.assert_array_equal(pairs, [[0, 1], [1, 0]])


@pytest.mark.parametrize(("offset", "count"), [(0.0199, 1), (-0.0199, 1), (0.0201, 0), (-0.0201, 0)])
def test_association_reaches_20_ms(offset: float, count: int) -> None:
    assert len(pair_by_time(np.array([5.0]), np.array([5.0 + offset]))) == count


def test_images_without_a_pose_are_dropped_with_a_count(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rows = [f"{t} {t} 0 0 0 0 0 1" for t in (0.5, 1.5, 2.5, 3.5)]
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        scene = load_scene(write(tmp_path, [0.5, 1.0, 1.5, 2.5, 3.5], rows))
    assert "dropped 1 of 5 images, no pose within 20 ms" in caplog.text
    assert [f.index for f in scene.frames] == [0, 2, 3, 4]


def test_clocks_that_never_meet_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none of the 2 images .* 1\.000 to 2\.000 s, .* 901\.500 .*one clock"):
        load_scene(write(tmp_path, [1, 2], ["901.5 0 0 0 0 0 0 1"]))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("0.5 1 2 3 0 0 0", r"groundtruth.txt:2: expected finite numbers `timestamp tx .*`, found `0.5 1"),
        ("0.5 1 2 nan 0 0 0 1", r"groundtruth.txt:2: expected finite numbers"),
        ("0.5 0 0 0 1 3 2 1", r"groundtruth.txt:2: the quaternion's norm is 3\.87.*check the order"),
    ],
)
def test_bad_row_is_refused(tmp_path: Path, row: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        load_scene(write(tmp_path, [0.5], [row]))


def test_bad_image_list_is_refused(tmp_path: Path) -> None:
    write(tmp_path, [0.5], ["0.5 0 0 0 0 0 0 1"])
    (tmp_path / "rgb.txt").write_text("rgb/0.5.png\n")
    with pytest.raises(DataError, match=r"rgb.txt:1: expected `timestamp path`"):
        load_scene(tmp_path)
    (tmp_path / "rgb.txt").write_text("# nothing\n")
    with pytest.raises(DataError, match=r"rgb.txt lists no image"):
        load_scene(tmp_path)


def test_missing_image_is_named(tmp_path: Path) -> None:
    write(tmp_path, [0.5], ["0.5 0 0 0 0 0 0 1"])
    (tmp_path / "rgb" / "0.500000.png").unlink()
    with pytest.raises(DataError, match=r"0.500000.png is missing, listed in rgb.txt; unpack"):
        load_scene(tmp_path)


def test_header_gives_the_order_of_the_quaternion(tmp_path: Path) -> None:
    write(tmp_path, [1.0, 2.0, 3.0], [])
    (tmp_path / "groundtruth.txt").write_text(
        "# timestamp tx ty tz qw qx qy qz\n" + "".join(f"{t} 1 2 3 0.7 0.1 0.1 0.7\n" for t in (1, 2, 3))
    )
    np.testing.assert_allclose(load_scene(tmp_path).frames[0].quat_wxyz, [0.7, 0.1, 0.1, 0.7])


@pytest.mark.parametrize(
    ("factor", "start", "unit"),
    [
        (1e9, 1600000000, "nanoseconds"),
        (1e6, 1600000000, "microseconds"),
        (1e3, 1600000000, "milliseconds"),
        (1e9, 0, "nanoseconds"),
    ],
)
def test_other_units_of_time_are_converted(
    factor: float, start: int, unit: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Poses are written 1 ms after the images, in seconds, so that only the right unit pairs them."""
    times = [start + 0.1 * i for i in range(5)]
    write(tmp_path, times, [f"{t + 0.001:.4f} {i} 0 0 0 0 0 1" for i, t in enumerate(times)])
    lines = [f"{round(t * factor)} rgb/{t:.6f}.png" for t in times]
    (tmp_path / "rgb.txt").write_text("\n".join(lines))
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        scene = load_scene(tmp_path)
    assert f"rgb.txt: the times are read as {unit}" in caplog.text
    np.testing.assert_allclose(np.array([f.timestamp for f in scene.frames], float), times, atol=1e-5, rtol=0)
    np.testing.assert_allclose([f.position_m[0] for f in scene.frames], range(5))


def test_bad_rows_of_images_are_counted_and_dropped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    times = [float(t) for t in range(8)]
    rows = [f"{t} {t} 0 0 0 0 0 1" for t in times]
    rows[1:5] = ["1 nan nan nan nan nan nan nan", "2 0 0 0 0 0 0 0", "3 1 2", "4 1e300 0 0 0 0 0 1"]
    write(tmp_path, times, rows)
    pattern = r"4 of 8 frames cannot be used: .*txt:3: .*txt:4: .*txt:5: .*and 1 more. Or .* data.on_bad_frame: drop"
    with pytest.raises(DataError, match=pattern):
        load_scene(tmp_path)
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        scene = load_scene(tmp_path, on_bad_frame="drop")
    assert "4 of 8 frames cannot be used" in caplog.text
    assert [f.index for f in scene.frames] == [0, 5, 6, 7]


def test_bad_rows_that_no_image_uses_refuse_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rows = [f"{t} {t} 0 0 0 0 0 1" for t in (1, 2, 3)]
    outside = ["-5 0 0 0 0 0 0 0", "-4 nan nan nan nan nan nan nan", "-3 1 2", "nan 0 0 0 0 0 0 1", "lost"]
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        assert len(load_scene(write(tmp_path, [1, 2, 3], [*rows, *outside])).frames) == 3
    assert "2 lines have no time and are not used, such as" in caplog.text


def test_association_list_names_the_colour_image(tmp_path: Path) -> None:
    write(tmp_path, [1, 2, 3], [f"{t} {t} 0 0 0 0 0 1" for t in (1, 2, 3)])
    lines = [f"{t}.003 depth/{t}.png {t} rgb/{t:.6f}.png" for t in (1, 2, 3)]
    (tmp_path / "rgb.txt").write_text("\n".join(lines))
    assert [f.image.parent.name for f in load_scene(tmp_path).frames] == ["rgb"] * 3


def test_lines_gone_from_the_image_list_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path, [1, 2, 3, 4], [f"{t} {t} 0 0 0 0 0 1" for t in (1, 2, 3, 4)])
    lines = (tmp_path / "rgb.txt").read_text().splitlines()
    (tmp_path / "rgb.txt").write_text("\n".join([*lines[:3], *lines[4:]]))
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        load_scene(tmp_path)
    assert "1 of 4 images are not in rgb.txt" in caplog.text


def test_times_without_their_last_digits_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path, [1600000000 + 0.1 * i for i in range(9)], [f"1.600000e+09 {i} 0 0 0 0 0 1" for i in range(9)])
    with caplog.at_level(logging.WARNING, "lightning_pose"), pytest.raises(DataError, match="has 1 frame; to train"):
        load_scene(tmp_path)
    assert "groundtruth.txt: 9 lines have 1 different times; write times with all digits" in caplog.text


@pytest.mark.parametrize(
    "name", ["a" * 300 + ".png", "9" * 5000 + "/1.png", "rgb/" + "9" * 5000 + "/1.png", "a/" * 3000, "../../x.png"]
)
def test_names_that_no_file_can_have_are_bad_frames(name: str, tmp_path: Path) -> None:
    write(tmp_path, [1, 2, 3, 4], [f"{t} {t} 0 0 0 0 0 1" for t in (1, 2, 3, 4)])
    with (tmp_path / "rgb.txt").open("a") as file:
        file.write(f"2.01 {name}\n")
    (tmp_path / "rgb.txt").write_text((tmp_path / "rgb.txt").read_text().replace("2.000000 rgb/2.000000.png\n", ""))
    with pytest.raises(DataError, match=r"1 of 4 frames cannot be used") as caught:
        load_scene(tmp_path)
    assert len(str(caught.value)) < 1200
    assert len(load_scene(tmp_path, on_bad_frame="drop").frames) == 3


def test_frame_numbers_and_images_in_another_folder(tmp_path: Path) -> None:
    for i in range(4):
        make_image(tmp_path / "images" / f"{i}.png")
    (tmp_path / "rgb.txt").write_text("".join(f"{i} images/{i}.png\n" for i in range(4)))
    (tmp_path / "groundtruth.txt").write_text("".join(f"{i} {i} 5 0 0 0 0 1\n" for i in range(4)))
    scene = load_scene(tmp_path)
    assert scene.format == "tum"
    np.testing.assert_allclose(scene.frames[2].position_m, [2, 5, 0])


@pytest.mark.real_data
@pytest.mark.skipif(not OFFICE.is_dir(), reason="hololens_office is not beside the checkout")
def test_hololens_office() -> None:
    scene = load_scene(OFFICE)
    sizes = {split: len(indices) for split, indices in scene.splits.items()}
    assert sizes == {"train": 268, "val": 30, "test": 75}
    np.testing.assert_allclose(scene.frames[0].position_m, [-1.943120, 0.112344, 4.679990])
    np.testing.assert_allclose(scene.frames[0].quat_wxyz, [0.150952, 0.793430, -0.122476, 0.576786], atol=1e-5)


def walk(count: int, lost: range, start: float = 1.0) -> list[str]:
    """Poses of a walk along x, the identity where tracking is lost."""
    places = ["0 0 0" if i in lost else f"{start + 0.02 * i} 0 0" for i in range(count)]
    return [f"{100 + i / 10:.1f} {place} 0 0 0 1" for i, place in enumerate(places)]


@pytest.mark.parametrize("lost", [range(8, 12), range(9, 10), range(16, 20)])
def test_identity_where_tracking_was_lost_is_no_pose(lost: range, tmp_path: Path) -> None:
    root = write(tmp_path / "walk", [100 + i / 10 for i in range(20)], walk(20, lost))
    with pytest.raises(DataError, match=rf"{len(lost)} of 20 frames cannot be used.*tracking was lost"):
        load_scene(root)
    assert len(load_scene(root, on_bad_frame="drop").frames) == 20 - len(lost)


@pytest.mark.parametrize(("lost", "start"), [(range(4), 1.0), (range(8, 12), -0.18), (range(20), 0.0)])
def test_a_walk_may_begin_at_the_origin_and_pass_it(lost: range, start: float, tmp_path: Path) -> None:
    root = write(tmp_path / "walk", [100 + i / 10 for i in range(20)], walk(20, lost, start))
    assert len(load_scene(root).frames) == 20
