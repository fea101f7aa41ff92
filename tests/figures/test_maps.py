"""Figures of a landmark map: what they show can be read off their artists."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from lightning_pose.figures.maps import MatchedImage, draw_matched_images, draw_trajectory


def make_image(inliers: int) -> MatchedImage:
    rng = np.random.default_rng(0)
    seen, projected = rng.uniform(0, 60, (9, 2)), rng.uniform(0, 60, (5, 2))
    return MatchedImage(np.zeros((48, 64, 3), np.uint8), seen, projected, projected + 1, np.arange(5) < inliers, "one")


def read_labels(figure: Figure) -> list[list[str]]:
    return [[text.get_text() for text in legend.get_texts()] for axes in figure.axes if (legend := axes.get_legend())]


def test_each_image_says_how_many_points_and_matches_it_has() -> None:
    figure = draw_matched_images([make_image(4), make_image(0), make_image(5)], "title")
    assert read_labels(figure) == [
        ["9 points in view", "4 inliers", "1 other matches"],
        ["9 points in view", "0 inliers", "5 other matches"],
        ["9 points in view", "5 inliers", "0 other matches"],
    ]
    assert [axes.axison for axes in figure.axes] == [True, True, True, False]
    figure.draw_without_rendering()


def test_points_lie_where_they_appear() -> None:
    image = make_image(5)
    axes = draw_matched_images([image]).axes[0]
    np.testing.assert_allclose(np.array(axes.lines[0].get_xydata()), image.seen)
    (segments, _) = axes.collections
    assert isinstance(segments, LineCollection)
    np.testing.assert_allclose(segments.get_segments(), np.stack([image.projected, image.observed], 1))
    assert axes.get_ylim() == (47.5, -0.5)


def test_a_trajectory_is_drawn_from_above_with_refused_images_between_the_others() -> None:
    position = np.column_stack([np.arange(5.0), np.zeros(5), np.arange(5.0) ** 2])
    position[2] = np.nan  # an image that could not be read
    accepted = np.array([True, True, False, True, True])
    points = np.random.default_rng(0).uniform(-1, 5, (50, 3))
    figure = draw_trajectory(points, position, accepted, down=np.array([0.1, 0.9, 0.2]))
    (axes,) = figure.axes
    assert (axes.get_xlabel()[0], axes.get_ylabel()[0]) == ("x", "z")
    (cross,) = (line for line in axes.lines if line.get_marker() == "x")
    assert np.asarray(cross.get_xydata()).tolist() == [[2.0, 5.0]]
    nowhere = draw_trajectory(None, np.full((2, 3), np.nan), np.zeros(2, bool))
    assert nowhere.axes[0].get_legend_handles_labels()[1] == ["refused, 2 of 2"]
