"""The figures of systems that take clips: their trajectories, errors by clip length, responses.

As in `figures.images`, each function returns a matplotlib `Figure` and touches neither pyplot, nor a display, nor the
disk; the model is blue and the truth black.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, MultipleLocator
from numpy.typing import ArrayLike

from lightning_pose.figures.style import (
    BASELINES,
    CLIP_BASELINES,
    MODEL,
    OTHERS,
    SMALLEST,
    STYLE,
    TRUTH,
    Errors,
    find_longest_axes,
    log_axis,
)

__all__ = ["draw_error_by_length", "draw_relative_trajectories", "draw_responses"]

PANELS = 9  # three by three: more would be too small to read
TITLE = 28  # letters above a panel that do not reach into the next one
COLUMNS = 8  # filters in a row


@matplotlib.rc_context(STYLE)
def draw_relative_trajectories(
    truth: Mapping[str, ArrayLike],
    prediction: Mapping[str, ArrayLike],
    title: str = "Trajectories relative to their first frame",
    unit: str = "m",
    errors: Mapping[str, float] | None = None,
) -> Figure:
    """True and predicted positions, one panel a sequence (thesis, fig. 6.3); a black dot marks where each begins.

    A panel shows the two axes along which its truth extends furthest. A prediction further outside the truth's
    bounds than their own size is cut off; where it is not finite it has a gap.

    Args:
        truth: sequence to (M, 3) positions in order; the first nine are drawn, and the title gives the total.
        prediction: sequence to (M, 3), in the same axes.
        title: the heading.
        unit: unit of the positions and of the errors.
        errors: sequence to its position error, shown in the panel's title unless it is NaN.
    """
    names = list(truth)[:PANELS]
    columns = max(1, math.ceil(math.sqrt(len(names))))
    rows = max(1, math.ceil(len(names) / columns))
    size = {1: 5.5, 2: 4.0}.get(columns, 3.2)
    figure = Figure(figsize=(size * columns, (size - 0.05) * rows + 0.7), dpi=150, layout="constrained")
    _add_heading(figure, title if len(names) == len(truth) else f"{title} ({len(names)} of {len(truth)})")
    panels = figure.subplots(rows, columns, squeeze=False).flat
    for axes, name in itertools.zip_longest(panels, names):
        if name is None:
            axes.remove()
            continue
        _draw_panel(axes, np.asarray(truth[name], float), np.asarray(prediction[name], float), unit)
        error = math.nan if errors is None else errors.get(name, math.nan)
        suffix = "" if math.isnan(error) else f"  {error:.3g} {unit}"
        axes.set_title(_shorten_name(name, TITLE - len(suffix)) + suffix, fontsize=9, pad=6)
    if names:
        figure.legend(handles=figure.axes[0].get_lines(), loc="outside lower center", ncols=3)
    return figure


@matplotlib.rc_context(STYLE)
def draw_error_by_length(
    lengths: ArrayLike, errors: Mapping[str, Errors], title: str = "Error by clip length", unit: str = "m"
) -> Figure:
    """Median position and orientation error against the length of a clip, one line a system (thesis, fig. 6.4).

    Args:
        lengths: (L,) ascending, in frames.
        errors: system to median position errors (L,) and median orientation errors (L,) in degrees; what is not
            finite is not drawn. `no_motion`, `constant_velocity` and `visual_odometry` have colours of their own.
        title: the heading.
        unit: unit of the position errors.
    """
    lengths = np.asarray(lengths, float)
    looks = _choose_looks(errors)
    figure = Figure(figsize=(10, 5.2), dpi=150, layout="constrained")
    _add_heading(figure, title)
    panels = figure.subplots(1, 2)
    for column, label in enumerate((f"median position error ({unit})", "median orientation error (°)")):
        axes, drawn = panels[column], [np.empty(0)]
        for name, medians in errors.items():
            y = np.asarray(medians[column], float)
            y = np.where(np.isfinite(y), np.maximum(y, SMALLEST), np.nan)
            color, dash = looks[name]
            width, size = (2.6, 6) if color == MODEL else (1.6, 4)
            axes.plot(lengths, y, "o", color=color, linestyle=dash, linewidth=width, markersize=size, label=name)
            drawn.append(y[np.isfinite(y)])
        log_axis(axes, "y", _decade_limits(np.concatenate(drawn)))
        _set_log_axis(axes, lengths)
        axes.set(xlabel="clip length (frames)", ylabel=label)
    if errors:
        figure.legend(handles=panels[0].get_lines(), loc="outside lower center", ncols=5, handlelength=3.5)
    return figure


@matplotlib.rc_context(STYLE)
def draw_responses(
    images: Sequence[ArrayLike], layers: Mapping[str, Sequence[ArrayLike]], title: str = "What the filters respond to"
) -> Figure:
    """A clip's frames, and below them each layer's responses to one of them, one row per layer (thesis, fig. 6.5).

    Each response has its own scale of gray, so that weak ones show too. A map far from square is stretched.

    Args:
        images: frames, (H, W) gray or (H, W, 3) colour, uint8 or 0 to 1; none leaves their row out.
        layers: layer ("convolution 1") to its filters' responses, (H, W) each; the first eight are drawn.
        title: the heading.
    """
    rows = {name: [np.asarray(image) for image in images][:COLUMNS] for name, images in layers.items()}
    if len(images):
        rows = {"input": [np.asarray(image) for image in images][:COLUMNS], **rows}
    columns = max([len(row) for row in rows.values()], default=1) or 1
    ratios = [_row_height(row) for row in rows.values()] or [1.0]
    side = max(1.0, 5.5 / columns)
    figure = Figure(figsize=(side * columns + 1.6, side * sum(ratios) + 1.0), dpi=150, layout="constrained")
    _add_heading(figure, title)
    panels = figure.subplots(len(ratios), columns, squeeze=False, gridspec_kw={"height_ratios": ratios})
    for axes in panels.flat:
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
    for line, (name, row), ratio in zip(panels, rows.items(), ratios, strict=False):
        line[0].set_ylabel(name, rotation=0, ha="right", va="center", labelpad=8)
        for axes, image in zip(line, row, strict=False):
            stretch = "equal" if math.isclose(ratio, image.shape[0] / image.shape[1], rel_tol=0.2) else "auto"
            scale = {"vmin": 0, "vmax": 255 if image.dtype == np.uint8 else 1} if name == "input" else {}
            axes.imshow(image, cmap="gray", aspect=stretch, interpolation="nearest", **scale)
    caption = "each response from its least (black) to its greatest (white)"
    figure.supxlabel(caption, x=0.99, ha="right", fontsize=9, color="#555555")
    return figure


def _add_heading(figure: Figure, title: str) -> None:
    """Write the figure's title at its top left."""
    figure.suptitle(title, x=0.015, ha="left", fontsize=12, fontweight="bold")


def _draw_panel(axes: Axes, truth: np.ndarray, prediction: np.ndarray, unit: str) -> None:
    """Draw one sequence's trajectories within square limits."""
    across, up = plane = find_longest_axes(truth)
    truth, prediction = truth[:, plane], prediction[:, plane]
    axes.plot(*truth.T, color=TRUTH, linewidth=1.8, solid_capstyle="round", label="truth")
    axes.plot(*prediction.T, color=MODEL, linewidth=1.6, solid_capstyle="round", label="prediction")
    axes.plot(*truth[0], "o", color=TRUTH, markersize=7, linestyle="none", label="start", zorder=3)
    low, high = _square_limits(truth, prediction)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel=f"{'xyz'[across]} ({unit})", ylabel=f"{'xyz'[up]} ({unit})")
    step = np.diff(MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(0, high[0] - low[0]))[0]
    axes.xaxis.set_major_locator(MultipleLocator(step))
    axes.yaxis.set_major_locator(MultipleLocator(step))
    axes.tick_params(labelsize=9)


def _square_limits(truth: np.ndarray, prediction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (2,) of a square around the truth and the prediction, as far as that is near the truth.

    Without motion in the truth, all of the prediction counts.
    """
    low, high = truth.min(axis=0), truth.max(axis=0)
    reach = (high - low).max() or math.inf
    near = np.clip(prediction[np.isfinite(prediction).all(axis=1)], low - reach, high + reach)
    held = np.concatenate([truth, near])
    low, high = held.min(axis=0), held.max(axis=0)
    half = 0.55 * max((high - low).max(), SMALLEST)
    return (low + high) / 2 - half, (low + high) / 2 + half


def _choose_looks(systems: Iterable[str]) -> dict[str, tuple[str, str | tuple]]:
    """Colour and dash of each system: a baseline's own, blue for the first of the others."""
    own, others = BASELINES | CLIP_BASELINES, itertools.cycle([(MODEL, "-"), *OTHERS])
    return {name: own[name] if name in own else next(others) for name in dict.fromkeys(systems)}


def _decade_limits(values: np.ndarray) -> tuple[float, float]:
    """Limits of a logarithmic axis around positive values, wide enough for it to have ticks to read."""
    if not len(values):
        return 0.1, 1.0
    low, high = float(values.min()) / 1.2, float(values.max()) * 1.2
    return min(low, high / 10), high


def _set_log_axis(axes: Axes, values: np.ndarray) -> None:
    """Make the x axis logarithmic, with a tick at each of a few positive values that is not too near the next."""
    limits = _decade_limits(values)
    log_axis(axes, "x", limits)
    gap = (limits[1] / limits[0]) ** 0.09
    kept: list[float] = []
    for value in sorted(values, reverse=True):
        if not kept or kept[-1] >= gap * value:
            kept.append(float(value))
    axes.xaxis.set_major_locator(FixedLocator(kept))


def _row_height(row: Sequence[np.ndarray]) -> float:
    """Height of a row of panels of width 1: the median of its images, limited to 0.4 to 1.4."""
    shapes = [image.shape for image in row]
    return float(np.clip(np.median([h / w for h, w, *_ in shapes]), 0.4, 1.4)) if shapes else 1.0


def _shorten_name(name: str, length: int) -> str:
    """A name of at most `length` letters, its middle left out if it is longer."""
    half = (length - 1) // 2
    return name if len(name) <= length else f"{name[:half]}…{name[-half:]}"
