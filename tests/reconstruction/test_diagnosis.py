"""What is wrong where frames have no pose, in words that name the frames."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lightning_pose.reconstruction.diagnosis import (
    PairFacts,
    describe_parallax,
    describe_rows,
    diagnose,
    find_components,
)

NAMES = [f"{i}.jpg" for i in range(8)]
RICH = np.full(8, 500)


def chain(*rows: int, kind: int = 2) -> list[PairFacts]:
    return [PairFacts(a, b, 100, kind) for a, b in pairwise(rows)]


def test_nothing_is_wrong() -> None:
    assert diagnose(NAMES, RICH, chain(*range(8)), range(8)) == []


def test_frames_with_few_keypoints() -> None:
    (reason,) = diagnose(NAMES, np.array([500] * 6 + [20, 30]), chain(*range(6)), range(6))
    assert reason.startswith("2 frames have fewer than 100 keypoints")
    assert reason.endswith("6.jpg to 7.jpg (2)")


def test_a_camera_that_only_turned() -> None:
    reasons = diagnose(NAMES, RICH, chain(*range(8), kind=6), [])
    assert reasons[0].startswith("too little parallax: in 7 of 7 matching pairs the camera only turned")


def test_frames_that_match_no_other() -> None:
    (reason,) = diagnose(NAMES, RICH, chain(0, 1, 2, 3, 4), range(5))
    assert reason.startswith("too few matches: 3 frames share 15 matches with no other: 5.jpg to 7.jpg (3)")


def test_several_pieces() -> None:
    (reason,) = diagnose(NAMES, RICH, chain(0, 1, 2, 3) + chain(4, 5, 6, 7), range(4))
    assert reason.startswith("several pieces, 2, which no match joins: 0.jpg to 3.jpg (4); 4.jpg to 7.jpg (4)")


def test_matches_that_fit_no_pose() -> None:
    (reason,) = diagnose(NAMES, RICH, chain(*range(8)), range(7))
    assert reason.startswith("their matches fit no camera pose: 7.jpg")


def test_components_and_runs() -> None:
    assert find_components(chain(5, 2, 7), 8)[0] == [2, 5, 7]
    assert describe_rows(range(0, 8, 1), NAMES) == "0.jpg to 7.jpg (8)"
    many = [f"{i}" for i in range(100)]
    assert describe_rows(range(0, 100, 2), many) == "0, 2, 4, 6, 8, 10, and 44 more stretches"


def test_cameras_that_are_close_together() -> None:
    turning, moving = chain(*range(8), kind=6), chain(*range(8))
    text, refused = describe_parallax(turning, 0.11)
    assert text.startswith("too little parallax: in 7 of 7 matching pairs the camera only turned")
    assert refused
    assert describe_parallax(turning, 1.0) == ("", False)  # a wall, seen from several places
    text, refused = describe_parallax(moving, 0.1)
    assert text.startswith("little parallax: the cameras span 10% of the distance to what they see")
    assert not refused
    assert describe_parallax(moving, 0.3) == ("", False)
