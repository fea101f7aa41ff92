"""Plots of clips: each figure draws without pyplot or a display, tells what it should, and survives poor data."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Callable
from io import BytesIO

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from lightning_pose.figures.clips import (
    draw_error_by_length,
    draw_relative_trajectories,
    draw_responses,
)
from lightning_pose.figures.style import CLIP_BASELINES, MODEL, TRUTH

RNG = np.random.default_rng(0)
PATH = np.stack([np.linspace(0, 4, 60), np.linspace(0, 0.1, 60), np.sin(np.linspace(0, 3, 60))], axis=1)
LENGTHS = np.array([2, 5, 10, 20, 50, 100, 200, 400])
ERRORS = {
    "CNN3D": (0.02 * LENGTHS**0.5, LENGTHS**0.5),
    "visual_odometry": (0.003 * LENGTHS**0.6, 0.1 * LENGTHS**0.6),
    "CNNRNN": (0.03 * LENGTHS**0.5, 1.2 * LENGTHS**0.5),
    "no_motion": (0.01 * LENGTHS**0.8, LENGTHS**0.8),
    "constant_velocity": (0.002 * LENGTHS**1.2, 0.3 * LENGTHS),
}
MAPS = {"convolution 1": [RNG.random((40, 40))] * 3, "activation 1": [RNG.random((20, 20))] * 11}


def draw(figure: Figure) -> Figure:
    file = BytesIO()
    figure.savefig(file, format="png", dpi=40)
    assert file.getvalue().startswith(b"\x89PNG")
    return figure


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def colors(axes: Axes) -> dict[str, object]:
    return {str(line.get_label()): line.get_color() for line in axes.get_lines()}


def points(line: Line2D) -> np.ndarray:
    return np.asarray(line.get_xydata())


def tick_labels(axes: Axes, which: str) -> list[Text]:
    """The labels in view; matplotlib keeps some that are not."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = sorted(axis.get_view_interval())
    ticks = axis.get_major_ticks(len(axis.get_major_locator()()))
    labels = [label for tick in ticks for label in (tick.label1, tick.label2) if low <= tick.get_loc() <= high]
    return [label for label in labels if label.get_visible() and label.get_text()]


def texts(figure: Figure) -> list[Text]:
    """All that is written in a figure."""
    written = [text for text in figure.findobj(Text) if isinstance(text, Text)]
    ticks = {id(t) for axes in figure.axes for a in (axes.xaxis, axes.yaxis) for t in a.findobj(Text)}
    labels = {id(t) for axes in figure.axes for t in (axes.xaxis.label, axes.yaxis.label)}
    written = [text for text in written if id(text) not in ticks or id(text) in labels]
    written += [label for axes in figure.axes for which in "xy" for label in tick_labels(axes, which)]
    return [text for text in written if text.get_visible() and text.get_text().strip()]


def test_clip_plots_leave_pyplot_alone() -> None:
    code = "import sys, lightning_pose.figures.clips; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_each_sequence_has_a_panel_with_its_two_longest_axes_at_one_scale() -> None:
    truth = {"heads/seq-01": PATH, "chess/seq-02": PATH[:, [1, 0, 2]]}
    prediction = {name: path + 0.1 for name, path in truth.items()}
    figure = draw(draw_relative_trajectories(truth, prediction, unit="scene", errors={"heads/seq-01": 0.12345}))
    first, second = figure.axes
    assert (first.get_xlabel(), first.get_ylabel()) == ("x (scene)", "z (scene)")
    assert (second.get_xlabel(), second.get_ylabel()) == ("y (scene)", "z (scene)")
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["heads/seq-01  0.123 scene", "chess/seq-02"]
    for axes in figure.axes:
        assert axes.get_aspect() == 1
        assert np.ptp(axes.get_xlim()) == pytest.approx(np.ptp(axes.get_ylim()))
    assert legend(figure) == ["truth", "prediction", "start"]


def test_truth_is_black_prediction_blue_and_the_start_a_dot() -> None:
    truth, prediction, start = draw(draw_relative_trajectories({"a": PATH}, {"a": PATH * 1.2})).axes[0].get_lines()
    assert (truth.get_color(), prediction.get_color(), start.get_color()) == (TRUTH, MODEL, TRUTH)
    np.testing.assert_allclose(points(prediction), 1.2 * PATH[:, [0, 2]])
    np.testing.assert_allclose(points(start), PATH[:1, [0, 2]])
    assert start.get_marker() == "o"


def test_a_prediction_that_strays_does_not_shrink_the_truth() -> None:
    far = PATH.copy()
    far[30:] *= 1000
    axes = draw(draw_relative_trajectories({"a": PATH}, {"a": far})).axes[0]
    assert 4 <= np.ptp(axes.get_xlim()) < 14
    axes = draw(draw_relative_trajectories({"still": 0 * PATH}, {"still": 100 * PATH})).axes[0]
    assert 400 <= np.ptp(axes.get_xlim()) < 500


def test_nine_sequences_of_more_are_drawn() -> None:
    paths = {f"seq-{i:02d}": PATH for i in range(12)}
    figure = draw(draw_relative_trajectories(paths, paths, title="Kitchen"))
    assert len(figure.axes) == 9
    assert figure.get_suptitle() == "Kitchen (9 of 12)"
    five = dict(itertools.islice(paths.items(), 5))
    assert len(draw(draw_relative_trajectories(five, paths)).axes) == 5


def test_error_by_length_has_a_line_a_system_in_its_own_colour() -> None:
    figure = draw(draw_error_by_length(LENGTHS, ERRORS, unit="scene"))
    position, orientation = figure.axes
    own = colors(position)
    assert own == colors(orientation)
    assert own["CNN3D"] == MODEL
    assert {name: own[name] for name in CLIP_BASELINES} == {name: color for name, (color, _) in CLIP_BASELINES.items()}
    assert len(set(own.values())) == len(ERRORS)
    assert legend(figure) == list(ERRORS)
    np.testing.assert_allclose(points(position.get_lines()[1]), np.stack([LENGTHS, ERRORS["visual_odometry"][0]], 1))
    assert (position.get_ylabel(), orientation.get_ylabel()) == (
        "median position error (scene)",
        "median orientation error (°)",
    )
    assert position.get_xscale() == "log"
    assert [label.get_text() for label in tick_labels(position, "x")] == [
        "400",
        "200",
        "100",
        "50",
        "20",
        "10",
        "5",
        "2",
    ]


def test_responses_have_a_row_a_layer_without_ticks() -> None:
    image = RNG.integers(0, 255, (30, 40, 3), dtype=np.uint8)
    figure = draw(draw_responses([image, image[..., 0]], MAPS))
    shown = [axes for axes in figure.axes if axes.images]
    assert len(shown) == 2 + 3 + 8
    assert [axes.get_ylabel() for axes in figure.axes[::8]] == ["input", "convolution 1", "activation 1"]
    assert not any(len(axes.get_xticks()) or len(axes.get_yticks()) for axes in figure.axes)
    assert {axes.images[0].get_cmap().name for axes in shown} == {"gray"}
    assert shown[1].images[0].get_clim() == (0, 255)
    assert shown[2].images[0].get_clim() == (MAPS["convolution 1"][0].min(), MAPS["convolution 1"][0].max())
    assert [axes.get_ylabel() for axes in draw(draw_responses([], MAPS)).axes[::8]] == ["convolution 1", "activation 1"]


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(
            lambda: draw_relative_trajectories(
                paths := {f"a_long_name/of_a_sequence-{i:02d}": PATH * 10.0 ** (i / 2 - 2) for i in range(9)},
                paths,
                errors=dict.fromkeys(paths, 0.00012345),
            ),
            id="trajectories",
        ),
        pytest.param(
            lambda: draw_relative_trajectories({"a": PATH}, {"a": PATH}, errors={"a": 1.0}), id="a trajectory"
        ),
        pytest.param(lambda: draw_error_by_length(LENGTHS, ERRORS), id="lengths"),
        pytest.param(
            lambda: draw_error_by_length(np.arange(2, 401), {"CNN3D": (np.ones(399), np.ones(399))}), id="all lengths"
        ),
        pytest.param(lambda: draw_responses([np.zeros((300, 64))] * 5, MAPS), id="responses"),
    ],
)
def test_no_two_texts_overlap_or_leave_the_figure(make: Callable[[], Figure]) -> None:
    figure = make()
    FigureCanvasAgg(figure).draw()
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts(figure)]
    assert len(boxes) > 3
    for name, box in boxes:
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1, name
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1, name
    for (name, box), (other, second) in itertools.combinations(boxes, 2):
        assert not box.overlaps(second), (name, other)


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: draw_relative_trajectories({}, {}), id="no sequence"),
        pytest.param(lambda: draw_relative_trajectories({"a": PATH[:1]}, {"a": PATH[:1]}), id="one frame"),
        pytest.param(lambda: draw_relative_trajectories({"a": 0 * PATH}, {"a": PATH}), id="no motion"),
        pytest.param(lambda: draw_relative_trajectories({"a": PATH}, {"a": np.nan * PATH}), id="prediction NaN"),
        pytest.param(
            lambda: draw_relative_trajectories({"a": PATH}, {"a": PATH}, errors={"a": np.inf}), id="error infinite"
        ),
        pytest.param(lambda: draw_error_by_length(LENGTHS, {}), id="no system"),
        pytest.param(lambda: draw_error_by_length([50], {"a": ([0.0], [np.nan])}), id="one length, zero and NaN"),
        pytest.param(lambda: draw_error_by_length([], {"a": ([], [])}), id="no length"),
        pytest.param(lambda: draw_responses([], {}), id="no layer"),
        pytest.param(
            lambda: draw_responses([], {"a": [np.zeros((4, 4)), np.full((4, 4), np.nan)], "b": []}), id="dead filter"
        ),
        pytest.param(
            lambda: draw_responses([], {"a": [np.ones((1, 500))], "b": [np.ones((500, 1))]}), id="far from square"
        ),
    ],
)
@pytest.mark.filterwarnings("error")
def test_poor_data_still_draws(make: Callable[[], Figure]) -> None:
    draw(make())
