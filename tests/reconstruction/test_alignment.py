"""Known distances and positions make a scene metric, or are refused in one line."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.geometry.similarity import Similarity
from lightning_pose.reconstruction.alignment import (
    KnownDistance,
    align_positions,
    find_frame,
    parse_distance,
    read_positions,
    scale_to_distance,
)

NAMES = ["a/img_1.jpg", "a/img_2.jpg", "b/img_2.jpg", "b/img_10.jpg", "b/img_11.jpg"]
CENTRES = dict(zip(NAMES, np.random.default_rng(0).normal(size=(5, 3)), strict=True))
TURN = Rotation.from_rotvec([0.3, -0.5, 2.0]).as_matrix()


def test_a_known_distance_sets_the_scale() -> None:
    scale = scale_to_distance(parse_distance("img_1 img_11.jpg 2.5"), CENTRES)
    ends = scale.apply(np.array([CENTRES["a/img_1.jpg"], CENTRES["b/img_11.jpg"]]))
    assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(2.5)


@pytest.mark.parametrize("text", ["a b", "a b 0", "a b far", "a a 2", "a b 1 m", "a b inf", ""])
def test_distances_that_are_none(text: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"--scale is {text!r}; give two frames")):
        parse_distance(text)


def test_frames_of_a_distance_need_a_pose_and_two_places() -> None:
    with pytest.raises(DataError, match=r"--scale: img_7 has no pose; give two of the 5 frames"):
        scale_to_distance(KnownDistance("img_1", "img_7", 1), CENTRES)
    with pytest.raises(DataError, match="are at one place"):
        scale_to_distance(KnownDistance("img_1", "img_10", 1), {**CENTRES, NAMES[3]: CENTRES[NAMES[0]]})


def test_known_positions_set_the_world() -> None:
    truth = Similarity(3.0, TURN, np.array([1.0, 2, 3]))
    known = {name: truth.apply(CENTRES[name]) for name in NAMES[:4]}
    known["not_there.jpg"] = np.zeros(3)
    found, errors = align_positions(known, CENTRES)
    np.testing.assert_allclose(found.rotation, TURN, atol=1e-12)
    assert found.scale == pytest.approx(3)
    assert list(errors) == NAMES[:4]
    assert max(errors.values()) < 1e-12


def test_residuals_are_metres() -> None:
    corners = np.array([[0.0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]])
    centres = dict(zip("abcd", corners, strict=True))
    _, errors = align_positions(dict(zip("abcd", corners + [[0, 0, s] for s in (1, -1, 1, -1)], strict=True)), centres)
    np.testing.assert_allclose(list(errors.values()), 1, atol=0.15)


def test_too_few_positions_and_positions_on_a_line() -> None:
    known = {name: CENTRES[name] for name in NAMES[:2]} | {"c.jpg": np.zeros(3)}
    with pytest.raises(DataError, match=r"2 of 3 known positions .*three or more \(without a pose: c.jpg\)"):
        align_positions(known, CENTRES)
    line = {name: np.array([i, 0.0, 0]) for i, name in enumerate(NAMES)}
    with pytest.raises(DataError, match="the 5 known positions are on one line"):
        align_positions(line, CENTRES)


def test_positions_near_a_line_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    near = {name: np.array([i, 0.02 * (i == 2), 0]) for i, name in enumerate(NAMES)}
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        align_positions(near, near)
    assert "the 5 known positions are nearly on one line" in caplog.text


def test_frames_are_found_by_name_and_number() -> None:
    assert find_frame("b/img_2.jpg", NAMES) == 2
    assert find_frame("/data/x/b/img_2.jpg", NAMES) == 2
    assert find_frame("img_10.png", NAMES) == 3
    assert find_frame("img_2.jpg", NAMES) is None  # there are two
    assert find_frame("12", ["frame_000001.jpg", "frame_000012.jpg"]) == 1


def test_files_of_positions(tmp_path: Path) -> None:
    path = tmp_path / "known.csv"
    path.write_text("name;z;x;y\na.jpg;3;1;2\n\nb.jpg;6;4;5\n")
    known = read_positions(path)
    np.testing.assert_array_equal([known["a.jpg"], known["b.jpg"]], [[1, 2, 3], [4, 5, 6]])
    path.write_text("image,tx,ty,tz,qw,qx,qy,qz,fx,fy,cx,cy\na.jpg,1,2,3,1,0,0,0,500,500,320,240\n")
    np.testing.assert_array_equal(read_positions(path)["a.jpg"], [1, 2, 3])
    path.write_text("image,tx,ty,tz\na.jpg,1,2\n")
    with pytest.raises(DataError, match=r"known.csv:2: expected `image,tx,ty,tz`, found `a.jpg,1,2`"):
        read_positions(path)
    path.write_text("a.jpg,1,2,3\n")
    with pytest.raises(DataError, match=r"the header is `a.jpg,1,2,3`; name the columns, such as image,tx,ty,tz"):
        read_positions(path)
