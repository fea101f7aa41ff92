"""The figure of a study: lines, bars, curves or keypoints, from what its trials measured."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from statistics import fmean

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from lightning_pose.features.keypoint_statistics import FrameKeypoints
from lightning_pose.figures.style import BASELINES, CLIP_BASELINES, MODEL, OTHERS, STYLE, log_axis
from lightning_pose.scenes.images import read_rgb
from lightning_pose.studies.figure_spec import FigureSpec
from lightning_pose.studies.table import Group, varying_settings
from lightning_pose.sweeps.space import SCENE

__all__ = ["draw_groups", "draw_keypoints"]

COLORS = [MODEL, *(color for color, _ in OTHERS), "#117733", "#999933", "#332288", "#1a1a1a"]
STRONGEST = (10, 50, 100, 300)
Lines = dict[str, list[Group]]


@matplotlib.rc_context(STYLE)
def draw_groups(groups: Sequence[Group], spec: FigureSpec, title: str) -> Figure:
    """One panel a metric; a line, a set of bars or a curve for each combination of the settings that x is not.

    Where a setting was tried with several seeds, lines and bars have the mean, and each trial is a dot.

    Args:
        groups: what was measured, each of a trial or more that ended.
        spec: what to show.
        title: the heading.
    """
    lines: Lines = {}
    for group in groups:
        lines.setdefault(
            _label_line(group, [key for key in varying_settings(groups) if key != spec.x], spec), []
        ).append(group)
    figure = Figure(figsize=(5.4 * len(spec.y) + 0.4, 4.6), dpi=150, layout="constrained")
    figure.suptitle(title, x=0.015, ha="left", fontsize=12, fontweight="bold")
    for axes, metric in zip(np.atleast_1d(figure.subplots(1, len(spec.y))), spec.y, strict=True):
        if spec.kind == "curve":
            _draw_curves(axes, lines, metric, spec)
        else:
            _draw_points(axes, lines, metric, spec)
        axes.set_ylabel(spec.label(metric))
        if "y" in spec.log:
            _scale_log(axes, "y")
        elif spec.kind != "curve":
            axes.set_ylim(0, 1.05 * axes.get_ylim()[1])
        if "x" in spec.log:
            _scale_log(axes, "x")
    named_lines = {label: handle for axes in figure.axes for handle, label in zip(*axes.get_legend_handles_labels())}  # noqa: B905
    if len(named_lines) > 1:
        labels, handles = list(named_lines), list(named_lines.values())
        figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))
    return figure


def _scale_log(axes: Axes, which: str) -> None:
    """Make an axis logarithmic, a little wider than what is drawn, and wide enough for ticks to read."""
    column = "xy".index(which)
    low, high = (
        np.asarray(axes.dataLim.minpos)[column],
        np.asarray(axes.dataLim.get_points())[1, column],
    )  # bars begin at 0
    log_axis(axes, which, (0.85 * low, max(1.15 * high, 4 * low)))


def _label_line(group: Group, keys: Sequence[str], spec: FigureSpec) -> str:
    """The legend's text for a line: its settings, by name where the value alone is not clear."""
    parts = []
    for key in (key for key in keys if key in group.values):
        value, name = group.values[key], group.names[key]
        if key == SCENE and not value:
            name = "synthetic room"
        elif not isinstance(value, str):
            name = f"{spec.label(key)} {name}"
        parts.append(name)
    return ", ".join(parts) or "model"


def _draw_points(axes: Axes, lines: Lines, metric: str, spec: FigureSpec) -> None:
    """Draw lines or bars over a setting, and baselines as dashed lines."""
    places, numeric = _place_values(lines, spec)
    held = [(places[_name_x(group, spec)], label, group) for label, groups in lines.items() for group in groups]
    labels = {x: list(dict.fromkeys(label for place, label, _ in held if place == x)) for x in places.values()}
    width = 0.8 / max(map(len, labels.values()))
    for color, label in zip(itertools.cycle(COLORS), lines, strict=False):
        points = [(x, group.all(metric)) for x, own, group in held if own == label and group.all(metric)]
        y = [fmean(values) for _, values in points]
        if spec.kind == "line":
            axes.plot([x for x, _ in points], y, "o-", color=color, linewidth=2, markersize=5, label=label)
        else:
            points = [(x + (labels[x].index(label) - (len(labels[x]) - 1) / 2) * width, values) for x, values in points]
            axes.bar([x for x, _ in points], y, 0.9 * width, color=color, label=label)
        seeds = [(x, value) for x, values in points for value in values]
        if len(seeds) > len(points):
            axes.plot(*zip(*seeds, strict=True), ".", color="#333333", markersize=5, alpha=0.6, linestyle="none")
    for baseline in spec.beside:
        name = _name_baseline(metric, baseline)
        at = {x: [v for place, _, group in held if place == x for v in group.all(name)] for x in sorted(labels)}
        if name != metric and any(at.values()):
            _draw_baseline(axes, baseline, {x: fmean(values) for x, values in at.items() if values})
    if numeric and "x" not in spec.log:
        axes.set_xticks(_thin_ticks(sorted(places.values())))
    elif not numeric:
        tilt = {"rotation": 20, "ha": "right"} if max(map(len, places)) > 10 else {}
        axes.set_xticks(list(places.values()), list(places), **tilt)
        axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel(spec.label(spec.x))


def _name_x(group: Group, spec: FigureSpec) -> str:
    return group.names.get(spec.x, "none")


def _place_values(lines: Lines, spec: FigureSpec) -> tuple[dict[str, float], bool]:
    """The place on the horizontal axis of each value, by its name, and whether the values themselves are the places.

    They are where a line is drawn over numbers, or over lists of one number; other values are placed in their order.
    """
    values = {_name_x(group, spec): group.values.get(spec.x) for groups in lines.values() for group in groups}
    plain = {k: v[0] if isinstance(v, list) and len(v) == 1 else v for k, v in values.items()}
    numbers = {k: float(v) for k, v in plain.items() if isinstance(v, int | float) and not isinstance(v, bool)}
    if spec.kind == "line" and len(numbers) == len(plain):
        return numbers, True
    return {name: float(i) for i, name in enumerate(plain)}, False


def _thin_ticks(ticks: list[float]) -> list[float]:
    """Without those so near the next that their numbers would touch."""
    kept: list[float] = []
    gap = 0.06 * (ticks[-1] - ticks[0])
    for tick in reversed(ticks):
        if not kept or kept[-1] - tick >= gap:
            kept.append(tick)
    return kept


def _draw_curves(axes: Axes, lines: Lines, name: str, spec: FigureSpec) -> None:
    """Draw the curve of each line; baselines are those of the first."""
    for color, (label, groups) in zip(itertools.cycle(COLORS), lines.items(), strict=False):
        curve = groups[0].curve(name)
        (line,) = axes.plot(list(curve), list(curve.values()), "o-", color=color, label=label)
        if name.endswith("histogram"):
            line.set(drawstyle="steps-post", marker="")
    for baseline in spec.beside:
        _draw_baseline(axes, baseline, next(iter(lines.values()))[0].curve(_name_baseline(name, baseline)))
    axes.set_xlabel(spec.label("x"))


def _name_baseline(metric: str, baseline: str) -> str:
    return metric.replace("test/", f"baseline/{baseline}/")


def _draw_baseline(axes: Axes, name: str, points: Mapping[int, float] | Mapping[float, float]) -> None:
    color, dash = (BASELINES | CLIP_BASELINES).get(name, ("#8c8c8c", "--"))
    axes.plot(list(points), list(points.values()), color=color, linestyle=dash, linewidth=1.6, label=name)


@matplotlib.rc_context(STYLE)
def draw_keypoints(frames: Mapping[str, FrameKeypoints], title: str) -> Figure:
    """A frame of each scene, with its 10, 50, 100 and 300 strongest features as red dots (thesis, fig. 2.2).

    Args:
        frames: by the scene's name.
        title: the heading.
    """
    figure = Figure(figsize=(3 * len(STRONGEST), 2.5 * len(frames) + 0.5), dpi=120, layout="constrained")
    figure.suptitle(title, x=0.015, ha="left", fontsize=12, fontweight="bold")
    panels = figure.subplots(len(frames), len(STRONGEST), squeeze=False)
    for axes, count in zip(panels[0], STRONGEST, strict=True):
        axes.set_title(f"{count} features", fontsize=10)
    for row, (scene, frame) in zip(panels, frames.items(), strict=True):
        image = read_rgb(frame.image)
        for axes, count in zip(row, STRONGEST, strict=True):
            axes.imshow(image)
            axes.plot(*frame.keypoints[:count, :2].T, ".", color="#e8000b", markersize=4, linestyle="none")
            axes.set(xticks=[], yticks=[], xlim=(0, image.shape[1]), ylim=(image.shape[0], 0))
        row[0].set_ylabel(scene)
    return figure
