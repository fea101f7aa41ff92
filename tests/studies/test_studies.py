"""Studies: sweeps over systems on their test frames, or over features alone, that end in a figure and a table."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import optuna
import pytest
import torch
import yaml

from lightning_pose.errors import ConfigError
from lightning_pose.features.base import Record
from lightning_pose.studies.figure import draw_groups
from lightning_pose.studies.figure_spec import FigureSpec, parse_figure_spec
from lightning_pose.studies.table import Group, build_rows, name_value, varying_settings
from lightning_pose.sweeps.plan import Plan, read_plan
from lightning_pose.sweeps.space import parse_space
from lightning_pose.terminal import format_markdown
from tests.helpers import Thumbnails, Workplace

Study = Callable[..., Path]
TEST = "test/position_median_m"


class Flat(Thumbnails):
    """The same pixels in one row."""

    @property
    def feature_shape(self) -> tuple[int, ...]:
        return (self.rows * self.columns,)

    def features(self, record: Record) -> np.ndarray:
        return record[self.primary].ravel()


@pytest.fixture
def study(workplace: Workplace) -> Study:
    """Write a study of the workplace's configs: `tiny`, and `small` of another architecture."""
    small = yaml.safe_load(workplace.config.read_text())
    small["model"] = {"class_path": "lightning_pose.models.SurfCNN", "init_args": {"channels": [4], "kernels": [3]}}
    (workplace.folder / "small.yaml").write_text(yaml.safe_dump(small))

    def write(**entries: Any) -> Path:
        file = workplace.folder / "study.yaml"
        rest = {"base": "tiny.yaml", "sampler": "grid", "settings": {"trainer.max_epochs": 1}}
        file.write_text(yaml.safe_dump(rest | {"space": {"model.units": [4, 8]}} | entries))
        return file

    return write


def rows(workplace: Workplace, name: str = "study-wall") -> list[dict[str, str]]:
    """What a study's `table.csv` holds."""
    with (workplace.folder / "mlruns" / "sweeps" / name / "table.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_study_of_two_systems_measures_the_test_frames(
    workplace: Workplace, study: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    file = study(
        base=["tiny.yaml", "small.yaml"],
        measure="test",
        space={
            "model.units": [4, 8],
            "model.cell": {"choices": ["gru"], "when": {"base": "tiny"}},
            "seed_everything": {"choices": [0, 1], "when": {"base": "small"}},
        },
        figure={"x": "model.units", "beside": ["retrieval_top1"], "table": [TEST, "cost/parameters"]},
    )
    assert workplace.command("sweep", file) == 0
    printed = capsys.readouterr().out
    assert "retrieval_top1" not in printed, "the table of each test is not printed"
    found = rows(workplace)
    assert [(row["base"], row["model.units"]) for row in found] == [
        ("tiny", "4"), ("tiny", "8"), ("small", "4"), ("small", "4"), ("small", "8"), ("small", "8"),
    ]  # fmt: skip
    assert [row["seed_everything"] for row in found[:2]] == ["", ""]
    assert {row["seed_everything"] for row in found[2:4]} == {"0", "1"}
    runs = {run.data.metrics[TEST]: run for run in workplace.runs() if "mlflow.parentRunId" in run.data.tags}
    assert {float(row[TEST]) for row in found} == set(runs), "MLflow has the same numbers"
    assert {run.data.tags["architecture"] for run in runs.values()} == {"SurfLSTM", "SurfCNN"}
    assert float(found[0]["cost/parameters"]) != float(found[2]["cost/parameters"])
    assert all(float(row["baseline/oracle/position_median_m"]) > 0 for row in found)
    folder = workplace.folder / "mlruns" / "sweeps" / "study-wall"
    assert plt.imread(folder / "figure.png").shape[0] > 500
    lines = (folder / "table.md").read_text().splitlines()
    assert lines[0] == "| system | units | trials | median position error (m) | parameters |"
    assert lines[2].startswith("| tiny | 4 | 1 | ")
    assert lines[4].startswith("| small | 4 | 2 | "), "seeds are one row"
    assert " to " in lines[4]
    assert not list((workplace.folder / "mlruns" / "checkpoints").glob("*")), "trials keep no checkpoints"
    parent = next(run for run in workplace.runs() if "mlflow.parentRunId" not in run.data.tags)
    kept = {artifact.path for artifact in workplace.client.list_artifacts(parent.info.run_id, "study")}
    assert kept == {"study/figure.png", "study/table.csv", "study/table.md"}
    best = yaml.safe_load((folder / "best.yaml").read_text())
    chosen = min(found, key=lambda row: float(row["val/loss"]))
    architecture = {"tiny": "SurfLSTM", "small": "SurfCNN"}[chosen["base"]]
    assert best["model"]["class_path"].endswith(architecture), "the validation frames chose"
    assert "base" not in best


def test_a_failed_trial_is_a_row_with_its_reason(workplace: Workplace, study: Study) -> None:
    file = study(measure="test", space={"model.units": [0, 4]}, figure={"x": "model.units"})
    assert workplace.command("sweep", file) == 0
    failed, ended = rows(workplace)
    assert failed["failed"].startswith("units is 0; give 1 or more")
    assert (failed[TEST], ended["failed"]) == ("", "")
    table = (workplace.folder / "mlruns" / "sweeps" / "study-wall" / "table.md").read_text()
    assert "| 0 | failed: units is 0" in table


def test_lambda_and_components_factorise_once(
    workplace: Workplace, study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = yaml.safe_load(workplace.config.read_text())
    config["model"] = {"class_path": "lightning_pose.models.LinearPoseNet", "init_args": {}}
    config["data"]["init_args"]["extractor"] = {"class_path": "tests.studies.test_studies.Flat"}
    (workplace.folder / "tiny.yaml").write_text(yaml.safe_dump(config))
    sizes = []
    eigh = torch.linalg.eigh
    monkeypatch.setattr(torch.linalg, "eigh", lambda a, **kwargs: sizes.append(len(a)) or eigh(a, **kwargs))
    space = {"model.lambdas": [[0.1], [10.0]], "model.components": [None, 4]}
    assert workplace.command("sweep", study(space=space, figure={"x": "model.lambdas", "kind": "bar"})) == 0
    assert len(rows(workplace)) == 4
    assert len({row["val/position_median_m"] for row in rows(workplace)}) == 4
    assert sorted(n for n in sizes if n > 4) == [22, 24], "training frames once, and with the validation frames once"


def test_features_are_counted_and_drawn(workplace: Workplace, study: Study) -> None:
    extractor = {"data.extractor": "lightning_pose.features.SURF", "data.extractor.n_features": 30}
    space = {"data.root": [str(workplace.scene)]}
    curve = {"kind": "curve", "y": "features/count_histogram", "table": ["features/count_max"]}
    file = study(measure="features", settings=extractor, space=space, figure=curve)
    assert workplace.command("sweep", file) == 0
    (row,) = rows(workplace)
    assert 0 <= float(row["features/count_min"]) < float(row["features/count_max"]) <= 30
    name = "study-wall"
    storage = f"sqlite:///{workplace.folder / 'mlruns' / 'optuna.db'}"
    (trial,) = optuna.load_study(study_name=name, storage=storage).trials
    curves = {key: np.array(value) for key, value in trial.user_attrs["curves"].items()}
    assert curves["features/count_histogram"][:, 1].sum() == pytest.approx(1)
    ranks, responses = curves["features/response_by_rank"].T
    assert ranks.tolist() == list(range(1, len(ranks) + 1))
    assert responses[0] == responses.max()
    assert not (workplace.folder / "mlruns" / "sweeps" / name / "best.yaml").exists(), "nothing was trained"
    pictures = study(measure="features", settings=extractor, space=space, figure={"kind": "pictures"})
    assert workplace.command("sweep", pictures, "--study", "pictures") == 0
    image = plt.imread(workplace.folder / "mlruns" / "sweeps" / "pictures" / "figure.png")
    red = (image[..., 0] > 0.8) & (image[..., 1] < 0.2)
    assert red.sum() > 20, "keypoints are red dots"


def test_pooled_features_have_no_keypoints(
    workplace: Workplace, study: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    assert workplace.command("sweep", study(measure="features"), "--n_trials", "1") == 2
    assert "thumbnails finds no keypoints; give an extractor that does" in capsys.readouterr().err


def test_the_command_line_narrows_a_study(study: Study) -> None:
    file = study(space={"model.units": [4, 8], "model.cell": ["gru", "rnn"]})

    def searched(**overrides: Any) -> dict[str, list[Any]]:
        plan: Plan = read_plan(file, {key.replace("__", "."): value for key, value in overrides.items()})
        return {parameter.key: parameter.example() for parameter in plan.space}

    assert searched(space__model__units=[16]) == {"model.units": [16], "model.cell": ["gru", "rnn"]}
    assert searched(model__units=5) == {"model.units": [5], "model.cell": ["gru", "rnn"]}
    assert searched(space__model__layers=[1, 2])["model.layers"] == [1, 2]


def check_file(file: Path) -> None:
    """Check a sweep file as the verb does before anything is trained."""
    plan = read_plan(file, {})
    parse_figure_spec(plan.figure, plan.measure, plan.space)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"measure": "train"}, "measure is 'train'; give test or features"),
        ({"figure": {"x": "model.unit"}}, "figure.x is model.unit, which is not searched; did you mean model.units"),
        ({"figure": {"x": "model.units", "z": 1}}, "figure has no entry 'z'; choose one of x, y"),
        ({"figure": {"kind": "pie"}}, "figure.kind is 'pie'; did you mean"),
        ({"figure": {"x": "model.units", "y": TEST}}, "figure shows test/position_median_m, but trials with"),
        ({"figure": {"x": "model.units", "log": ["z"]}}, r"figure.log is \['z'\]; give"),
        ({"figure": {"x": "model.units", "kind": "curve"}}, "figure of kind curve has no setting along its axis"),
        ({"figure": 3}, "figure is 3; give {x: "),
        ({"base": ["tiny.yaml", "tiny.yaml"]}, "base configs of the same file name"),
        ({"base": []}, "names no base config"),
        ({"space": {"model.loss.orientation_weight": [1.0, 9.0]}}, "objective val/loss means something else for each"),
        ({"measure": "features", "objective": "val/loss"}, "objective val/loss is not known"),
        ({"base": ["tiny.yaml", "small.yaml"], "space": {"model.cell": ["gru"]}}, "space.model.cell is no setting"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_malformed_study_is_refused(entries: dict[str, Any], message: str, study: Study) -> None:
    with pytest.raises(ConfigError, match=message):
        check_file(study(**entries))


def figure_spec(x: str = "model.units", **entries: Any) -> FigureSpec:
    made = parse_figure_spec({"x": x, **entries}, "test", parse_space({x: [1, 2], "model.cell": ["gru"]}))
    assert made is not None
    return made


def test_names_of_values() -> None:
    values = ["lightning_pose.features.SURF", "/data/fr1.xyz", [8.0], [1, 2], None, True, 0.1, 30, "efficientnet_lite0"]
    assert [name_value(value) for value in values] == [
        "SURF", "fr1.xyz", "8", "[1, 2]", "none", "yes", "0.1", "30", "efficientnet_lite0",
    ]  # fmt: skip


def test_a_table_has_means_and_their_range() -> None:
    groups = [
        Group({"model.units": 1, "model.cell": "gru"}, [{TEST: 0.1}, {TEST: 0.3}]),
        Group({"model.units": 2, "model.cell": "gru"}, [{TEST: 12345.0}]),
        Group({"model.units": 3, "model.cell": "gru"}, reason="no | such"),
    ]
    assert varying_settings(groups) == ["model.units"]
    assert format_markdown(*build_rows(groups, figure_spec(y=TEST))).splitlines() == [
        "| units | trials | median position error (m) |",
        "| --- | --- | --- |",
        "| 1 | 2 | 0.2 (0.1 to 0.3) |",
        "| 2 | 1 | 12,345 |",
        "| 3 | 0 | failed: no \\| such |",
    ]


def test_a_figure_has_a_line_for_each_other_setting() -> None:
    beside = {TEST.replace("test/", "baseline/oracle/"): 0.05}
    groups = [
        Group({"model.units": units, "model.cell": cell}, [{TEST: units * scale, **beside}])
        for cell, scale in (("gru", 0.1), ("rnn", 0.2))
        for units in (1, 2, 4)
    ]
    (axes,) = draw_groups(groups, figure_spec(y=TEST, beside=["oracle"]), "title").axes
    drawn = {line.get_label(): np.asarray(line.get_xydata()).tolist() for line in axes.get_lines()}
    assert drawn == {
        "gru": [[1, 0.1], [2, 0.2], [4, pytest.approx(0.4)]],
        "rnn": [[1, 0.2], [2, 0.4], [4, pytest.approx(0.8)]],
        "oracle": [[1, 0.05], [2, 0.05], [4, 0.05]],
    }
    (axes,) = draw_groups(groups, figure_spec(y=TEST, kind="bar"), "title").axes
    heights = sorted(round(bar.get_height(), 6) for bar in axes.patches)  # type: ignore[attr-defined]
    assert heights == [0.1, 0.2, 0.2, 0.4, 0.4, 0.8]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["1", "2", "4"]


@pytest.mark.parametrize("kind", ["line", "bar"])
def test_logarithmic_axes_hold_what_is_drawn(kind: str) -> None:
    groups = [Group({"model.units": units, "model.cell": "gru"}, [{TEST: units**2 / 100}]) for units in (1, 10, 100)]
    (axes,) = draw_groups(groups, figure_spec(y=TEST, kind=kind, log=["x", "y"] if kind == "line" else ["y"]), "").axes
    assert axes.get_yscale() == "log"
    low, high = axes.get_ylim()
    assert 0.005 < low < 0.01
    assert 100 < high < 200
    if kind == "line":
        assert [axes.get_xscale(), axes.get_xlim()[0] < 1 < 100 < axes.get_xlim()[1]] == ["log", True]


def test_curves_are_averaged_over_seeds() -> None:
    group = Group({}, [{}, {}], [{"c": {2: 1.0, 4: 3.0}}, {"c": {2: 2.0}}])
    assert group.curve("c") == {2: 1.5, 4: 3.0}
    assert group.curve("other") == {}
