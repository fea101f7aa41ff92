"""Images that a list names: where they are found, which of several is read, and their numbers."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.image_files import (
    ImageFinder,
    choose_images,
    make_natural_key,
    number_images,
    parse_image_line,
    warn_of_unlisted_images,
)
from tests.data.helpers import make_image


@pytest.mark.parametrize(
    ("listed", "found"),
    [
        ("rgb/1.png", "rgb/1.png"),
        ("rgb\\1.png", "rgb/1.png"),
        ("./rgb/1.png", "rgb/1.png"),
        ("1.png", "rgb/1.png"),
        ("rgb/1.PNG", "rgb/1.png"),
        ("RGB/1.png", "rgb/1.png"),
        ("rgb/1.jpg", "rgb/1.png"),
        ("rgb/2.png", "rgb/2.JPG"),
        ("/data/office/rgb/1.png", "rgb/1.png"),
        ("C:\\data\\office\\rgb\\1.png", "rgb/1.png"),
        ("rgb/1600000000.25.png", "rgb/1600000000.25.jpg"),
    ],
)
def test_found_with_a_warning_where_the_list_differs(
    listed: str, found: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("rgb/1.png", "rgb/2.JPG", "rgb/1600000000.25.jpg", "rgb/._1.png"):
        make_image(tmp_path / name)
    finder = ImageFinder(tmp_path)
    path = finder.find(listed)
    assert path.is_file()
    assert path.relative_to(tmp_path).as_posix() == found
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        finder.warn("rgb.txt")
    assert ("1 images are not as listed" in caplog.text) == (path != tmp_path / listed)


@pytest.mark.parametrize("listed", ["rgb/3.png", "depth/1.png", "a" * 300 + ".png", "a/" * 3000, "rgb/\0.png", ""])
def test_what_is_missing_stays_missing(listed: str, tmp_path: Path) -> None:
    make_image(tmp_path / "rgb" / "1.png")
    make_image(tmp_path / "depth" / "2.png")
    assert ImageFinder(tmp_path).find(listed) == tmp_path / listed


def test_two_names_never_find_one_image(tmp_path: Path) -> None:
    make_image(tmp_path / "1.png")
    finder = ImageFinder(tmp_path)
    assert finder.find("/a/1.png") == tmp_path / "1.png"
    assert finder.find("/b/1.png") == Path("/b/1.png")


def test_of_several_files_png_is_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    paths = [tmp_path / name for name in ("1.jpg", "1.png", "1.webp")]
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        assert choose_images({1: paths, 2: paths[::-1], 3: paths[:1]}) == {1: paths[1], 2: paths[1], 3: paths[0]}
    assert "2 frames have several images; 1.png is read, not 1.jpg" in caplog.text


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1.5 rgb/1.png", ("1.5", "rgb/1.png")),
        ("1.5,rgb/1.png", ("1.5", "rgb/1.png")),
        ("1.5 my images/1 a.png", ("1.5", "my images/1 a.png")),
        ("1 depth/1.png 2 rgb/2.png", ("2", "rgb/2.png")),
        ("1 rgb/1.png 2 depth/2.png", ("1", "rgb/1.png")),
        ("1 color/1.png 2 d/2.png", ("1", "color/1.png")),
        ("1 rgb_and_depth/rgb/1.png 2 rgb_and_depth/depth/2.png", ("1", "rgb_and_depth/rgb/1.png")),
        ("1,depth\\1.png,2,rgb\\2.png", ("2", "rgb\\2.png")),
    ],
)
def test_colour_image_of_a_line(line: str, expected: tuple[str, str]) -> None:
    assert parse_image_line(line) == expected


def test_two_images_of_unknown_kind_are_refused() -> None:
    with pytest.raises(DataError, match="do not say which is colour; call the folders rgb and depth"):
        parse_image_line("1 a/1.png 1 b/1.png")


@pytest.mark.parametrize(
    ("names", "indices"),
    [
        (["frame00003.png", "frame00012.png"], [3, 12]),
        (["img_20190415_103007.png", "img_20190415_103000.png"], [1, 0]),
        (["2019-04-15 10.59.59.jpg", "2019-04-15 11.00.02.jpg"], [0, 1]),
        (["IMG20190415A.jpg", "IMG20190415B.jpg"], [0, 1]),
        (["cam1_0007.png", "cam1_0009.png"], [7, 9]),
        (["left_1.png", "right_1.png", "left_2.png"], [0, 2, 1]),
        (["a.png", "b.png"], [0, 1]),
        (["1403636579763555584.png", "1403636579813555456.png"], [0, 1]),
        (["9" * 5000 + ".png", "1.png"], [1, 0]),
        (["2b1.png"], [0]),
        (["frame7.png"], [7]),
    ],
)
def test_numbers_tell_images_apart(names: list[str], indices: list[int]) -> None:
    assert number_images(names) == indices


def test_natural_order_of_any_number() -> None:
    names = ["seq10", "seq2", "seq" + "9" * 5000, "seq02"]
    assert sorted(names, key=make_natural_key) == ["seq2", "seq02", "seq10", "seq" + "9" * 5000]


def test_images_in_no_list_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    images = [make_image(tmp_path / f"{i}.png") for i in range(5)]
    for name in ("0.jpg", "7.depth.png", "._3.png", "notes.txt"):
        make_image(tmp_path / name)
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        warn_of_unlisted_images(images[:3], "rgb.txt")
    assert "2 of 7 images are not in rgb.txt and are not used, such as 3.png" in caplog.text
