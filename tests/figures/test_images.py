"""Plots: each figure draws without pyplot or a display, tells what it should, and survives poor data."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from io import BytesIO
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.figure import Figure

from lightning_pose.figures.images import draw_cumulative_errors, draw_error_vs_distance, draw_trajectory
from lightning_pose.figures.style import Errors

RNG = np.random.default_rng(0)
PATH = np.stack([np.linspace(0, 4, 60), np.zeros(60), np.sin(np.linspace(0, 3, 60))], axis=1)
ERRORS: Errors = (RNG.lognormal(-2, 1, 60), RNG.lognormal(1, 1, 60))
WORSE: Errors = (2 * np.asarray(ERRORS[0]), 2 * np.asarray(ERRORS[1]))


def draw(figure: Figure) -> Figure:
    file = BytesIO()
    figure.savefig(file, format="png", dpi=40)
    assert file.getvalue().startswith(b"\x89PNG")
    return figure


def legend(figure: Figure, panel: int | None = None) -> list[str]:
    legends = figure.legends if panel is None else [figure.axes[panel].get_legend()]
    assert legends[0] is not None
    return [text.get_text() for text in legends[0].get_texts()]


def test_plots_leave_pyplot_alone() -> None:
    code = "import sys, lightning_pose.figures.images; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_trajectory_shows_the_two_longest_axes_at_one_scale() -> None:
    axes = draw(draw_trajectory(PATH, PATH + 0.05, title="a room")).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_title(loc="left")) == ("x (m)", "z (m)", "a room")
    assert axes.get_aspect() == 1


def test_trajectory_has_one_line_per_sequence_and_one_legend_entry_for_all() -> None:
    figure = draw(draw_trajectory(PATH, PATH, ["seq-01"] * 20 + ["seq-02"] * 40, PATH + 1, unit="scene"))
    lines = [line for line in figure.axes[0].get_lines() if line.get_label() == "truth"]
    assert [len(np.asarray(line.get_xdata())) for line in lines] == [20, 40]
    assert legend(figure) == ["training frames", "truth", "prediction"]
    assert figure.axes[0].get_xlabel() == "x (scene)"


def test_trajectory_counts_what_lies_outside() -> None:
    prediction = PATH.copy()
    prediction[3], prediction[9] = 1000, np.nan
    figure = draw(draw_trajectory(PATH, prediction))
    assert legend(figure) == ["truth", "prediction (2 outside)"]
    assert figure.axes[0].get_xlim()[1] < 10


def test_cumulative_errors_ranks_by_median() -> None:
    figure = draw(draw_cumulative_errors(ERRORS, {"retrieval_top1": WORSE, "no_motion": WORSE}, name="SurfLSTM"))
    median = np.median(np.asarray(ERRORS[0]))
    assert legend(figure, 0)[0] == f"SurfLSTM  {median:.3g} m"
    assert [entry.split()[0] for entry in legend(figure, 1)] == ["SurfLSTM", "retrieval_top1", "no_motion"]
    assert [axes.get_xscale() for axes in figure.axes] == ["log", "log"]


def test_cumulative_curves_rise_to_the_share_that_is_finite() -> None:
    position, orientation = (np.array(errors) for errors in ERRORS)
    position[:15] = np.nan
    curve = draw(draw_cumulative_errors((position, orientation), {})).axes[0].get_lines()[0]
    x, y = np.asarray(curve.get_xdata()), np.asarray(curve.get_ydata())
    assert all(a <= b for a, b in pairwise(y))
    assert y[x <= np.nanmax(position)].max() == pytest.approx(0.75)


def test_error_vs_distance_joins_the_medians_of_tenths() -> None:
    distance = np.arange(1.0, 41)
    axes = draw(draw_error_vs_distance(2 * distance, distance)).axes[0]
    medians = axes.get_lines()[2]
    np.testing.assert_allclose(np.asarray(medians.get_xdata()), np.arange(2.5, 41, 4))
    np.testing.assert_allclose(np.asarray(medians.get_ydata()), 2 * np.arange(2.5, 41, 4))


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: draw_trajectory(PATH[:1], PATH[:1]), id="one frame"),
        pytest.param(lambda: draw_trajectory(PATH, np.full_like(PATH, np.nan)), id="all predictions NaN"),
        pytest.param(lambda: draw_cumulative_errors((np.zeros(3), np.zeros(3)), {}), id="no error at all"),
        pytest.param(
            lambda: draw_cumulative_errors((np.full(3, np.nan), np.ones(3)), {"oracle": ERRORS}), id="model NaN"
        ),
        pytest.param(lambda: draw_error_vs_distance(np.ones(3), np.zeros(3)), id="test frames among the training"),
        pytest.param(lambda: draw_error_vs_distance(np.full(3, np.nan), np.ones(3)), id="errors NaN"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_poor_data_still_draws(make: Callable[[], Figure]) -> None:
    draw(make())
