"""Frames are chosen as often as the image moves, the sharpest of each stretch, and repetitions never."""

from __future__ import annotations

import cv2
import numpy as np

from lightning_pose.reconstruction.frame_choice import FrameMeasures, choose_frames, measure_frames

TEXTURE = cv2.resize(np.random.default_rng(0).integers(0, 255, (60, 200), np.uint8), None, fx=8, fy=8)


def view(x: int) -> np.ndarray:
    """The texture from column x on, (240, 320)."""
    return TEXTURE[100:340, x : x + 320]


def test_motion_is_a_share_of_the_width() -> None:
    measures = measure_frames([view(0), view(16), view(16), view(24), view(900)])
    np.testing.assert_allclose(measures.motion, [0, 0.05, 0, 0.025, 1], atol=0.002)


def test_motion_does_not_depend_on_the_size_of_the_image() -> None:
    large = [cv2.resize(view(x), None, fx=3, fy=3) for x in (0, 16)]
    np.testing.assert_allclose(measure_frames(large).motion, [0, 0.05], atol=0.002)


def test_a_blurred_frame_is_less_sharp() -> None:
    sharpness = measure_frames([view(0), cv2.GaussianBlur(view(0), (9, 9), 3)]).sharpness
    assert sharpness[1] < sharpness[0] / 2


def test_the_sharpest_of_each_stretch_is_chosen() -> None:
    motion = np.array([0, 0.01, 0.01, 0.01, 0.01, 0.01])
    sharpness = np.array([1.0, 3, 2, 5, 4, 6])
    np.testing.assert_array_equal(choose_frames(FrameMeasures(sharpness, motion), step=0.03), [1, 5])
    np.testing.assert_array_equal(choose_frames(FrameMeasures(sharpness, motion), every=2), [1, 3, 5])


def test_repetitions_are_never_chosen() -> None:
    measures = FrameMeasures(np.array([1.0, 9, 1, 9, 9]), np.array([0, 0, 1.0, 0, 0]))
    np.testing.assert_array_equal(choose_frames(measures), [0, 2])
    np.testing.assert_array_equal(choose_frames(measures, every=1), [0, 2])


def test_every_frame_is_chosen_where_each_moves() -> None:
    measures = FrameMeasures(np.arange(5.0), np.array([0, 0.5, 0.5, 1, 0.1]))
    np.testing.assert_array_equal(choose_frames(measures), np.arange(5))


def test_a_slow_camera_is_not_lost() -> None:
    measures = FrameMeasures(np.ones(100), np.full(100, 0.001))
    assert 3 <= len(choose_frames(measures, step=0.03)) <= 5
