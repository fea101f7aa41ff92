"""The figure of a study: lines, bars, curves or keypoints, from what its trials measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from lightning_pose.features.keypoint_statistics import FrameKeypoints
from lightning_pose.figures.style import BASELINES, CLIP_BASELINES, MODEL, OTHERS, STYLE, log_axis
from lightning_pose.scenes.images import read_rgb
from lightning_pose.studies.figure_spec import FigureSpec
from lightning_pose.studies.table import Cell, varying
from lightning_pose.sweeps.space import SCENE

__all__ = ["draw_cells", "draw_keypoints"]

COLORS = [MODEL, *(color for color, _ in OTHERS), "#117733", "#999933", "#332288", "#1a1a1a"]
STRONGEST = (10, 50, 100, 300)
Lines = dict[str, list[Cell]]


@matplotlib.rc_context(STYLE)
def draw_cells(cells: Sequence[Cell], spec: FigureSpec, title: str) -> Figure:
    """One panel a metric; a line, a group of bars or a curve for each combination of the settings that x is not.

    Where a setting was tried with several seeds, lines and bars have the mean, and each trial is a dot.

    Args:
        cells: what was measured; what failed is left out.
        spec: what to show.
        title: the heading.
    """
    cells = [cell for cell in cells if cell.metrics]
    lines = _lines(cells, spec)
    figure = Figure(figsize=(5.4 * len(spec.y) + 0.4, 4.6), dpi=150, layout="constrained")
    figure.suptitle(title, x=0.015, ha="left", fontsize=12, fontweight="bold")
    for axes, metric in zip(np.atleast_1d(figure.subplots(1, len(spec.y))), spec.y, strict=True):
        if spec.kind == "curve":
            _curves(axes, lines, metric, spec)
        else:
            _settings(axes, lines, metric, spec)
        axes.set_ylabel(spec.label(metric))
        if "y" in spec.log:
            _make_log(axes, "y")
        elif spec.kind != "curve":
            axes.set_ylim(0, 1.05 * axes.get_ylim()[1])
        if "x" in spec.log:
            _make_log(axes, "x")
    named_lines = {label: handle for axes in figure.axes for handle, label in zip(*axes.get_legend_handles_labels())}  # noqa: B905
    if len(named_lines) > 1:
        labels, handles = list(named_lines), list(named_lines.values())
        figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))
    return figure


def _make_log(axes: Axes, which: str) -> None:
    """Logarithmic, a little wider than what is drawn, and wide enough for ticks to read."""
    i = "xy".index(which)
    low, high = axes.dataLim.minpos[i], axes.dataLim.get_points()[1, i]  # type: ignore[index]  # bars begin at 0
    log_axis(axes, which, (0.85 * low, max(1.15 * high, 4 * low)))


def _lines(cells: Sequence[Cell], spec: FigureSpec) -> Lines:
    """Cells by the settings that distinguish lines."""
    apart = [key for key in varying(cells) if key != spec.x]
    lines: Lines = {}
    for cell in cells:
        parts = [_told(key, cell, spec) for key in apart if key in cell.values]
        lines.setdefault(", ".join(parts) or "model", []).append(cell)
    return lines


def _told(key: str, cell: Cell, spec: FigureSpec) -> str:
    """A setting in a legend: its value, and its name where the value alone is not clear."""
    value = cell.values[key]
    if key == SCENE and not value:
        return "synthetic room"
    return cell.names[key] if isinstance(value, str) else f"{spec.label(key)} {cell.names[key]}"


def _settings(axes: Axes, lines: Lines, metric: str, spec: FigureSpec) -> None:
    places = _places(lines, spec)
    numeric = spec.kind == "line" and all(isinstance(place, float) for place in places.values())
    bars = {
        place: [label for label, cells in lines.items() if _has(cells, spec, name)] for name, place in places.items()
    }
    width = 0.8 / max(len(labels) for labels in bars.values())
    for i, (label, cells) in enumerate(lines.items()):
        held = [(places[_at(cell, spec)], cell) for cell in cells if cell.all(metric)]
        x, y = [place for place, _ in held], [fmean(cell.all(metric)) for _, cell in held]
        color = COLORS[i % len(COLORS)]
        if spec.kind == "line":
            axes.plot(x, y, "o-", color=color, linewidth=2, markersize=5, label=label)
        else:
            x = [place + (bars[place].index(label) - (len(bars[place]) - 1) / 2) * width for place in x]
            axes.bar(x, y, 0.9 * width, color=color, label=label)
        seeds = [(place, value) for place, (_, cell) in zip(x, held, strict=True) for value in cell.all(metric)]
        if len(seeds) > len(held):
            axes.plot(*zip(*seeds, strict=True), ".", color="#333333", markersize=5, alpha=0.6, linestyle="none")
    _baselines(axes, lines, metric, spec, places)
    if numeric and "x" not in spec.log:
        axes.set_xticks(_thinned(sorted(places.values())))
    elif not numeric:
        tilt = {"rotation": 20, "ha": "right"} if max(map(len, places)) > 10 else {}
        axes.set_xticks(list(places.values()), list(places), **tilt)
        axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel(spec.label(spec.x))


def _at(cell: Cell, spec: FigureSpec) -> str:
    """The name of a cell's place on the axis."""
    return cell.names.get(spec.x, "none")


def _has(cells: Sequence[Cell], spec: FigureSpec, name: str) -> bool:
    return any(_at(cell, spec) == name for cell in cells)


def _places(lines: Lines, spec: FigureSpec) -> dict[str, float | int]:
    """Where on the axis each value lies, by its name: numbers where they are, in a line, others in their order."""
    held = [cell for cells in lines.values() for cell in cells]
    values = {_at(cell, spec): _plain(cell.values.get(spec.x)) for cell in held}
    if spec.kind == "line" and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values.values()):
        return {name: float(value) for name, value in values.items()}
    return {name: i for i, name in enumerate(values)}


def _plain(value: Any) -> Any:
    """`[8.0]`, a list of one, is its number."""
    return value[0] if isinstance(value, list) and len(value) == 1 else value


def _thinned(ticks: list[float]) -> list[float]:
    """Without those so near the next that their numbers would touch."""
    kept: list[float] = []
    gap = 0.06 * (ticks[-1] - ticks[0])
    for tick in reversed(ticks):
        if not kept or kept[-1] - tick >= gap:
            kept.append(tick)
    return kept


def _curves(axes: Axes, lines: Lines, name: str, spec: FigureSpec) -> None:
    for i, (label, cells) in enumerate(lines.items()):
        curve = cells[0].curve(name)
        (line,) = axes.plot(list(curve), list(curve.values()), "o-", color=COLORS[i % len(COLORS)], label=label)
        if name.endswith("histogram"):
            line.set(drawstyle="steps-post", marker="")
    for baseline in spec.beside:
        _draw_baseline(axes, baseline, next(iter(lines.values()))[0].curve(_of_baseline(name, baseline)))
    axes.set_xlabel(spec.label("x"))


def _baselines(axes: Axes, lines: Lines, metric: str, spec: FigureSpec, places: Mapping[str, float | int]) -> None:
    """What stands beside the model at each place, as a dashed line."""
    for baseline in spec.beside:
        name = _of_baseline(metric, baseline)
        at: dict[float, list[float]] = {}
        for cell in (cell for cells in lines.values() for cell in cells):
            at.setdefault(places[_at(cell, spec)], []).extend(cell.all(name))
        drawn = {place: fmean(values) for place, values in sorted(at.items()) if values}
        if drawn and name != metric:
            _draw_baseline(axes, baseline, drawn)


def _of_baseline(metric: str, baseline: str) -> str:
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
