"""The figures of a test of single images: trajectory, cumulative errors, and error against distance.

Each function returns a matplotlib `Figure` and touches neither pyplot, nor a display, nor the disk. The
model is blue and the truth black throughout; baselines keep their own colour (Okabe & Ito's palette, which
the colour-blind can distinguish) and dash.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, MultipleLocator, PercentFormatter
from numpy.typing import ArrayLike

from lightning_pose.figures.style import (
    BASELINES,
    MODEL,
    OTHERS,
    SMALLEST,
    STYLE,
    TRAINING,
    TRUTH,
    Errors,
    find_log_limits,
    find_longest_axes,
    log_axis,
    nan_to_infinity,
)

__all__ = ["draw_cumulative_errors", "draw_error_vs_distance", "draw_trajectory"]


@matplotlib.rc_context(STYLE)
def draw_trajectory(
    truth_m: ArrayLike,
    prediction_m: ArrayLike,
    sequences: Sequence[str] | None = None,
    training_m: ArrayLike | None = None,
    title: str = "Trajectory",
    unit: str = "m",
) -> Figure:
    """True and predicted positions in the plane of the two axes along which the truth extends furthest.

    A segment joins each prediction to its truth; a ring marks where each sequence begins. The limits hold the
    truth and nearly all predictions; the legend counts the predictions outside.

    Args:
        truth_m: (N, 3), the frames of a sequence together and in order.
        prediction_m: (N, 3); a row with NaN is not drawn, and counts as outside.
        sequences: N names; one line is drawn for each. All frames are one sequence when None.
        training_m: (M, 3) positions the model learned from, drawn faintly.
        title: the heading.
        unit: unit of the positions.
    """
    truth, prediction = np.asarray(truth_m, float), np.asarray(prediction_m, float)
    names = np.asarray(["" for _ in truth] if sequences is None else sequences)
    plane = across, up = find_longest_axes(truth)
    training = np.asarray(np.empty((0, 3)) if training_m is None else training_m, float)[:, plane]
    truth, prediction = truth[:, plane], prediction[:, plane]
    low, high = _find_limits(truth, prediction)
    outside = int((~((prediction >= low) & (prediction <= high)).all(axis=1)).sum())

    width, height = high - low
    figure = Figure(figsize=(8, float(np.clip(7.1 * height / width, 2.5, 7)) + 1.3), dpi=150, layout="constrained")
    axes = figure.add_subplot(title=title)
    axes.plot(*training.T, ".", color=TRAINING, markersize=3, label="training frames")
    segments = list(np.stack([truth, prediction], axis=1))
    axes.add_collection(LineCollection(segments, colors=MODEL, linewidths=0.7, alpha=0.3))
    for name in dict.fromkeys(names):
        line = truth[names == name]
        axes.plot(*line.T, color=TRUTH, linewidth=1.8, solid_capstyle="round", label="truth")
        axes.plot(*line[0], "o", color="white", markeredgecolor=TRUTH, markeredgewidth=1.5, markersize=6, zorder=3)
    label = f"prediction ({outside} outside)" if outside else "prediction"
    size = 4 if len(truth) <= 500 else 2.5
    axes.plot(*prediction.T, "o", color=MODEL, markeredgewidth=0, markersize=size, alpha=0.8, label=label)
    axes.set(
        xlim=(low[0], high[0]),
        ylim=(low[1], high[1]),
        aspect="equal",
        xlabel=f"{'xyz'[across]} ({unit})",
        ylabel=f"{'xyz'[up]} ({unit})",
    )
    step = np.diff(MaxNLocator(8).tick_values(0, max(width, height)))[0]
    axes.xaxis.set_major_locator(MultipleLocator(step))
    axes.yaxis.set_major_locator(MultipleLocator(step))
    handles = {str(line.get_label()): line for line in axes.get_legend_handles_labels()[0]}
    if not len(training):
        del handles["training frames"]
    figure.legend(handles=list(handles.values()), loc="outside lower center", ncols=3)
    return figure


@matplotlib.rc_context(STYLE)
def draw_cumulative_errors(
    model: Errors,
    baselines: Mapping[str, Errors],
    name: str = "model",
    title: str = "Share of frames within an error",
    unit: str = "m",
) -> Figure:
    """The share of frames within each position error, and within each orientation error; higher is better.

    The legends show the medians, worst last. NaN counts as infinite, so a curve may end below 100 %.

    Args:
        model: the model's errors.
        baselines: errors of what it is compared with, by name.
        name: the model's name.
        title: the heading.
        unit: unit of the position errors.
    """
    figure = Figure(figsize=(10, 5.2), dpi=150, layout="constrained")
    figure.suptitle(title, x=0.015, ha="left", fontsize=12, fontweight="bold")
    looks = {other: BASELINES.get(other, OTHERS[i % len(OTHERS)]) for i, other in enumerate(baselines)}
    looks[name] = (MODEL, "-")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, column, label, symbol in (
        (panels[0], 0, f"position error ({unit})", f" {unit}"),
        (panels[1], 1, "orientation error (°)", "°"),
    ):
        curves = {other: np.sort(nan_to_infinity(errors[column])) for other, errors in baselines.items()}
        curves[name] = np.sort(nan_to_infinity(model[column]))
        limits = find_log_limits(np.concatenate(list(curves.values())))
        for zorder, (curve, errors) in enumerate(curves.items(), start=2):
            color, dash = looks[curve]
            x = np.concatenate([[limits[0]], np.minimum(errors, 2 * limits[1])])
            y = np.arange(len(x)) / len(errors)
            style = {"color": color, "linestyle": dash, "linewidth": 2.6 if curve == name else 1.6}
            median = f"{curve}  {np.median(errors):.3g}{symbol}"
            axes.plot(x, y, drawstyle="steps-post", label=median, zorder=zorder, **style)
        log_axis(axes, "x", limits)
        axes.set(ylim=(0, 1.02), xlabel=label)
        axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        best_first = np.argsort([np.median(errors) for errors in curves.values()], kind="stable")
        lines = [axes.get_lines()[i] for i in best_first]
        axes.legend(handles=lines, title="median", loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    panels[0].set_ylabel("share of frames")
    return figure


@matplotlib.rc_context(STYLE)
def draw_error_vs_distance(
    position_error_m: ArrayLike,
    distance_m: ArrayLike,
    title: str = "Error against distance from the training poses",
    unit: str = "m",
) -> Figure:
    """Position error of each frame against its distance to the nearest training position.

    On the diagonal the model is as far off as the best training pose: above it, a perfect retrieval would
    do better; below it, the model interpolates between training poses.

    Args:
        position_error_m: (N,) the model's; a frame whose error is not finite is not drawn.
        distance_m: (N,) the error of the `oracle` baseline.
        title: the heading.
        unit: unit of both.
    """
    error, distance = nan_to_infinity(position_error_m), np.asarray(distance_m, float)
    finite = np.isfinite(error)
    error, distance = np.maximum(error[finite], SMALLEST), np.maximum(distance[finite], SMALLEST)
    limits = find_log_limits(np.concatenate([error, distance]))
    figure = Figure(figsize=(6, 6), dpi=150, layout="constrained")
    axes = figure.add_subplot(title=title)
    color, dash = BASELINES["oracle"]
    axes.plot(limits, limits, color=color, linestyle=dash, linewidth=1.6, label="nearest training pose")
    axes.plot(distance, error, "o", color=MODEL, markersize=4, alpha=0.35, markeredgewidth=0, label="test frame")
    centres, medians = _binned_median(distance, error)
    axes.plot(centres, medians, "o-", color=TRUTH, linewidth=1.8, markersize=5, label="median of a tenth")
    for axis in ("x", "y"):
        log_axis(axes, axis, limits)
    axes.set(
        aspect="equal", xlabel=f"distance to the nearest training pose ({unit})", ylabel=f"position error ({unit})"
    )
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def _find_limits(truth: np.ndarray, prediction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(2,) lower and upper limits that hold all truth and the middle 96 % of predictions, with a margin."""
    drawn = prediction[np.isfinite(prediction).all(axis=1)]
    ends = np.quantile(drawn, [0.02, 0.98], axis=0) if len(drawn) else np.empty((0, 2))
    held = np.concatenate([truth, ends])
    low, high = held.min(axis=0), held.max(axis=0)
    margin = 0.05 * max((high - low).max(), SMALLEST)
    return low - margin, high + margin


def _binned_median(x: np.ndarray, y: np.ndarray, n_bins: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Medians of x and of y over ten equally filled bins of x (fewer where there are fewer points)."""
    bins = [part for part in np.array_split(np.argsort(x, kind="stable"), n_bins) if len(part)]
    return np.array([np.median(x[part]) for part in bins]), np.array([np.median(y[part]) for part in bins])
