"""The figures of a landmark map: the map from above, errors against inliers, and how well radii hold errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from lightning_pose.figures.style import (
    BASELINES,
    MODEL,
    SMALLEST,
    STYLE,
    TRAINING,
    TRUTH,
    find_log_limits,
    find_longest_axes,
    log_axis,
)

__all__ = [
    "MatchedImage",
    "draw_calibration",
    "draw_error_vs_inliers",
    "draw_map",
    "draw_matched_images",
    "draw_trajectory",
]

REFUSED = "#D55E00"


class MatchedImage(NamedTuple):
    """An image and what a map shows in it, in pixels.

    Attributes:
        pixels: (H, W) or (H, W, 3) uint8.
        seen: (V, 2), where points of the map appear that the image should show.
        projected: (K, 2), where those appear that were matched.
        observed: (K, 2), their keypoints.
        inlier: (K,) bool.
        caption: above the image.
    """

    pixels: np.ndarray
    seen: np.ndarray
    projected: np.ndarray
    observed: np.ndarray
    inlier: np.ndarray
    caption: str


@matplotlib.rc_context(STYLE)
def draw_matched_images(images: Sequence[MatchedImage], title: str = "Points of the map in images") -> Figure:
    """Images in two columns, with the map's points in them, and a segment from each matched one to its keypoint."""
    rows = -(-len(images) // 2)
    figure = Figure(figsize=(11, 4.3 * rows + 0.6), dpi=110, layout="constrained")
    figure.suptitle(title)
    for axes, image in zip(figure.subplots(rows, 2, squeeze=False).flat, images, strict=False):
        height, width = image.pixels.shape[:2]
        axes.imshow(image.pixels, cmap="gray", vmin=0, vmax=255)
        axes.plot(*image.seen.T, ".", color="#f0e442", markersize=1.5, label=f"{len(image.seen)} points in view")
        for chosen, color, label in ((image.inlier, MODEL, "inliers"), (~image.inlier, REFUSED, "other matches")):
            segments = list(np.stack([image.projected[chosen], image.observed[chosen]], axis=1))
            axes.add_collection(LineCollection(segments, colors=color, linewidths=1))
            axes.plot(
                *image.observed[chosen].T, "o", color=color, markersize=4, markerfacecolor="none", markeredgewidth=0.8,
                label=f"{chosen.sum()} {label}",
            )  # fmt: skip
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
        axes.set_title(image.caption, fontsize=9)
        axes.legend(loc="lower right", fontsize=7, frameon=True, framealpha=0.8)
    for axes in list(figure.axes)[len(images) :]:
        axes.set_axis_off()
    return figure


def _start_view(
    points: np.ndarray, cameras: np.ndarray, plane: list[int], title: str, unit: str
) -> tuple[Figure, Axes]:
    """A figure of a plane of the world with the map's points (P, 3) in it, which holds all cameras (N, 3)."""
    held = np.concatenate([np.quantile(points, [0.02, 0.98], axis=0) if len(points) else cameras[:1], cameras])
    low, high = held.min(axis=0)[plane], held.max(axis=0)[plane]
    margin = 0.05 * (high - low).max() + SMALLEST
    figure = Figure(figsize=(8, 7), dpi=150, layout="constrained")
    axes = figure.add_subplot(
        title=title,
        xlim=(low[0] - margin, high[0] + margin),
        ylim=(low[1] - margin, high[1] + margin),
        aspect="equal",
        xlabel=f"{'xyz'[plane[0]]} ({unit})",
        ylabel=f"{'xyz'[plane[1]]} ({unit})",
    )
    if len(points):
        axes.plot(*points[:, plane].T, ".", color=TRAINING, markersize=1.5, label=f"{len(points):,} points of the map")
    return figure, axes


@matplotlib.rc_context(STYLE)
def draw_map(
    points: np.ndarray,
    training: np.ndarray,
    truth: np.ndarray,
    prediction: np.ndarray,
    accepted: np.ndarray,
    title: str = "Landmark map",
    unit: str = "m",
) -> Figure:
    """The map's points, the training cameras, and the test frames, in the plane in which the cameras move most.

    Args:
        points: (P, 3), of the map.
        training: (F, 3), camera centres of the training frames.
        truth: (N, 3), of the test frames.
        prediction: (N, 3), a segment joins each to its truth.
        accepted: (N,) bool.
        title: the heading.
        unit: unit of all.
    """
    cameras = np.concatenate([training, truth])
    plane = find_longest_axes(cameras)
    figure, axes = _start_view(points, cameras, plane, title, unit)
    axes.plot(*training[:, plane].T, ".", color="#8c8c8c", markersize=3, label="training frames")
    segments = list(np.stack([truth[:, plane], prediction[:, plane]], axis=1))
    axes.add_collection(LineCollection(segments, colors=TRUTH, linewidths=0.7, alpha=0.5))
    for chosen, color, label in ((accepted, MODEL, "accepted"), (~accepted, REFUSED, "refused")):
        if chosen.any():
            count = f"{label}, {chosen.sum()} of {len(chosen)}"
            axes.plot(*prediction[chosen][:, plane].T, "o", color=color, markersize=4, markeredgewidth=0, label=count)
    figure.legend(loc="outside lower center", ncols=4)
    return figure


@matplotlib.rc_context(STYLE)
def draw_trajectory(
    points: np.ndarray | None,
    position: np.ndarray,
    accepted: np.ndarray,
    down: np.ndarray | None = None,
    title: str = "Trajectory",
) -> Figure:
    """A located trajectory over the map's points, from above.

    Accepted images in a row are joined by a line; refused ones are crosses, between those before and after them.

    Args:
        points: (P, 3), of the map; None without one.
        position: (N, 3), in order; nan where an image has no pose.
        accepted: (N,) bool.
        down: (3,), mean of the cameras' down axes; the axis of the world nearest to it is not drawn. By default, the
            axis along which the camera moves least.
        title: the heading.
    """
    rows = np.arange(len(position))
    if accepted.any():
        known = position[accepted]
        position = np.column_stack([np.interp(rows, rows[accepted], column) for column in known.T])
    else:
        known = position[np.isfinite(position).all(axis=1)]
        known = known if len(known) else np.zeros((1, 3))
    points = known[:0] if points is None else points
    plane = find_longest_axes(known)
    if down is not None and down.any():
        plane = [axis for axis in range(3) if axis != int(np.abs(down).argmax())]
    figure, axes = _start_view(points, known, plane, title, "scene's unit")
    joined = np.where(accepted[:, None], position, np.nan)[:, plane]
    axes.plot(*joined.T, "-", color=MODEL, linewidth=0.8, alpha=0.7)
    for chosen, marker, color, label in ((accepted, ".", MODEL, "accepted"), (~accepted, "x", REFUSED, "refused")):
        if chosen.any():
            count = f"{label}, {chosen.sum()} of {len(chosen)}"
            axes.plot(*position[chosen][:, plane].T, marker, color=color, markersize=5, label=count)
    figure.legend(loc="outside lower center", ncols=4)
    return figure


@matplotlib.rc_context(STYLE)
def draw_error_vs_inliers(
    position_error: np.ndarray, inliers: np.ndarray, accepted: np.ndarray, title: str = "", unit: str = "m"
) -> Figure:
    """Position error of each test frame against its inliers, by which the map accepts or refuses.

    Args:
        position_error: (N,).
        inliers: (N,).
        accepted: (N,) bool.
        title: the heading.
        unit: unit of the errors.
    """
    figure = Figure(figsize=(7, 5), dpi=150, layout="constrained")
    axes = figure.add_subplot(title=title or "Errors and inliers")
    for chosen, color, label in ((accepted, MODEL, "accepted"), (~accepted, REFUSED, "refused")):
        error = np.maximum(position_error[chosen], SMALLEST)
        axes.plot(inliers[chosen], error, "o", color=color, markersize=4, alpha=0.6, markeredgewidth=0, label=label)
    log_axis(axes, "y", find_log_limits(np.maximum(position_error, SMALLEST)))
    axes.set(xlabel="inliers", ylabel=f"position error ({unit})", xlim=(0, None))
    axes.legend()
    return figure


@matplotlib.rc_context(STYLE)
def draw_calibration(
    errors: tuple[np.ndarray, np.ndarray], radii: tuple[np.ndarray, np.ndarray], title: str = "", unit: str = "m"
) -> Figure:
    """The share of frames whose error lies within a multiple of their 90 % radius; at 1 it should be 90 %.

    Args:
        errors: of positions and orientations (degrees), (N,) each.
        radii: the same.
        title: the heading.
        unit: unit of the positions, for the legend.
    """
    figure = Figure(figsize=(7, 5), dpi=150, layout="constrained")
    axes = figure.add_subplot(title=title or "Calibration")
    for error, radius, color, label in (
        (errors[0], radii[0], MODEL, f"position, median radius {np.median(radii[0]):.3g} {unit}"),
        (errors[1], radii[1], BASELINES["oracle"][0], f"orientation, median radius {np.median(radii[1]):.3g}°"),
    ):
        ratio = np.sort(error / radius)
        axes.plot(ratio, np.arange(1, len(ratio) + 1) / len(ratio), drawstyle="steps-post", color=color, label=label)
    axes.axvline(1, color=TRUTH, linewidth=1, linestyle=(0, (5, 3)))
    axes.axhline(0.9, color=TRUTH, linewidth=1, linestyle=(0, (5, 3)))
    axes.set(xlabel="error by radius", ylabel="share of frames", xlim=(0, 3), ylim=(0, 1.02))
    axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    axes.legend(loc="lower right")
    return figure
