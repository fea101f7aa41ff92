"""What all figures share: colours, fonts and axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import ArrayLike

from lightning_pose.metrics import catalog

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

__all__ = [
    "BASELINES",
    "CLIP_BASELINES",
    "MODEL",
    "OTHERS",
    "SMALLEST",
    "STYLE",
    "TRAINING",
    "TRUTH",
    "Errors",
    "find_log_limits",
    "find_longest_axes",
    "log_axis",
]

Errors = tuple[ArrayLike, ArrayLike]
"""Position errors (N,) in the scene's unit, and orientation errors (N,) in degrees."""

MODEL, TRUTH, TRAINING = "#0072B2", "#1a1a1a", "#c4c4c4"

Look = tuple[str, str | tuple]
"""Colour and dashes of a line."""

GRAY_DOTS: Look = ("#8c8c8c", (0, (1, 1.5)))
RED_DASHES: Look = ("#D55E00", (0, (5, 1.5)))
ORANGE_DASHES: Look = ("#E69F00", (0, (3, 1.5)))
GREEN_DASH_DOTS: Look = ("#009E73", (0, (5, 1.5, 1, 1.5)))


def assign_looks(clips: bool, looks: Sequence[Look]) -> dict[str, Look]:
    """The catalogue's baselines of clips or of single images, in its order, each with a look while there are looks."""
    names = [name for name, baseline in catalog.BASELINES.items() if baseline.clips == clips]
    return dict(zip(names, looks, strict=False))


BASELINES = assign_looks(False, (GRAY_DOTS, RED_DASHES, ORANGE_DASHES, GREEN_DASH_DOTS))
CLIP_BASELINES = assign_looks(True, (GRAY_DOTS, RED_DASHES, GREEN_DASH_DOTS))

OTHERS: list[Look] = [("#CC79A7", (0, (5, 1.5))), ("#56B4E9", (0, (3, 1.5))), ("#882255", (0, (1, 1)))]

SMALLEST = 1e-4  # metres or degrees, drawn for zero, which a logarithmic axis cannot show

STYLE: dict[RcKeyType, object] = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.titlepad": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.labelcolor": "#333333",
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.8,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "legend.frameon": False,
    "legend.fontsize": 9,
    "figure.facecolor": "white",
    "axes.facecolor": "white",
}


def find_longest_axes(truth_m: np.ndarray) -> list[int]:
    """The two axes, in order, along which positions (N, 3) extend furthest."""
    return sorted(int(axis) for axis in np.argsort(-np.ptp(truth_m, axis=0), kind="stable")[:2])


def nan_to_infinity(errors: ArrayLike) -> np.ndarray:
    """Errors as an array in which infinity replaces NaN."""
    values = np.asarray(errors, float)
    return np.where(np.isnan(values), np.inf, values)


def find_log_limits(errors: np.ndarray) -> tuple[float, float]:
    """Limits that hold all finite errors but the smallest hundredth, which would stretch a logarithmic axis."""
    finite = np.maximum(errors[np.isfinite(errors)], SMALLEST)
    if not len(finite):
        return 0.01, 1.0
    return float(np.quantile(finite, 0.01)) * 0.9, float(finite.max()) * 1.1


def log_axis(axes: Axes, which: str, limits: tuple[float, float]) -> None:
    """Make the axis `x` or `y` logarithmic between limits, with plain numbers at 1, 2, 5 or at powers of ten."""
    axes.set(**{f"{which}scale": "log", f"{which}lim": limits})
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if limits[1] < 1000 * limits[0] else (1,)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
