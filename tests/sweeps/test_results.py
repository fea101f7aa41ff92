"""The results of a sweep: figures with the right direction, distinct names, and figures that cannot be drawn."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import optuna
import pytest
import yaml
from optuna.distributions import FloatDistribution
from optuna.study import StudyDirection
from optuna.trial import create_trial

from lightning_pose.studies.table import Group, name_scenes
from lightning_pose.sweeps.plan import Objective
from lightning_pose.sweeps.results import plan_figures
from tests.helpers import Workplace


def study_of(*directions: str) -> optuna.Study:
    """Of a value that grows with x alone, up to where it does so; y matters in the upper half."""
    study = optuna.create_study(directions=[StudyDirection[name.upper()] for name in directions])
    spread = FloatDistribution(0, 1)
    for i in range(40):
        x, y = i / 39, (i * 17 % 40) / 39
        values = [x + (10 * y if x > 0.5 else 0)] * len(directions)
        study.add_trial(create_trial(params={"x": x, "y": y}, distributions={"x": spread, "y": spread}, values=values))
    return study


@pytest.mark.parametrize("direction", ["minimize", "maximize"])
def test_the_history_has_the_best_so_far(direction: str) -> None:
    figures = dict(plan_figures(study_of(direction), [Objective("v", direction == "maximize")]))
    axes: Any = figures["history"]()
    labels = axes.get_legend_handles_labels()[1]
    assert "Best Value" in labels
    (line,) = (line for line in axes.get_lines() if line.get_label() == "Best Value")
    drawn = list(line.get_ydata())
    assert drawn == sorted(drawn, reverse=direction == "minimize")
    plt.close("all")


def test_importance_is_that_for_the_best_also_among_several_objectives(monkeypatch: pytest.MonkeyPatch) -> None:
    from optuna.visualization import matplotlib as draw

    asked: dict[str, Any] = {}
    monkeypatch.setattr(draw, "plot_param_importances", lambda study, **named: asked.update(named))
    study = study_of("maximize", "minimize")
    objectives = [Objective("val/recall_5cm_5deg", True), Objective("cost/parameters")]
    figures = dict(plan_figures(study, objectives))
    trial = study.trials[-1]
    figures["importance_val_recall_5cm_5deg"]()
    assert asked["target"](trial) == -trial.values[0]
    figures["importance_cost_parameters"]()
    assert asked["target"](trial) == trial.values[1]


def test_folders_of_one_name_have_distinct_names() -> None:
    def names(*roots: Any) -> list[str]:
        groups = [Group({"data.root": root}) for root in roots]
        name_scenes(groups)
        return [group.names["data.root"] for group in groups]

    assert names("/data/chess/", "/data/fire") == ["chess", "fire"]
    assert names("apt1/kitchen", "apt2/kitchen", None) == ["apt1/kitchen", "apt2/kitchen", "none"]
    assert names("fr1.xyz") == ["fr1.xyz"]


@pytest.fixture
def study_file(workplace: Workplace) -> Callable[..., Path]:
    def write(**figure: Any) -> Path:
        file = workplace.folder / "study.yaml"
        entries = {"base": "tiny.yaml", "settings": {"trainer.max_epochs": 1}, "space": {"model.units": [4]}}
        grid = {"sampler": "grid", "measure": "test", "figure": {"x": "model.units"} | figure}
        file.write_text(yaml.safe_dump(entries | grid))
        return file

    return write


def test_a_figure_of_what_was_not_measured_is_refused_after_the_results(
    workplace: Workplace, study_file: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = workplace.folder / "mlruns" / "sweeps" / "study-wall"
    for wrong, said in (
        ({"y": ["test/position_medain_m"]}, "no trial has measured (did you mean test/position_median_m?)"),
        ({"beside": ["oracel"]}, "figure.beside has oracel, which is no baseline (did you mean oracle?)"),
    ):
        assert workplace.command("sweep", study_file(**wrong)) == 2
        assert said in capsys.readouterr().err
        assert (folder / "best.yaml").is_file()
    assert workplace.command("sweep", study_file(beside=["oracle"])) == 0
    assert (folder / "figure.png").is_file()
    assert "1 complete" in capsys.readouterr().out, "nothing is run again"


def test_a_reason_with_brackets_is_shown_whole(
    workplace: Workplace,
    study_file: Callable[..., Path],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from lightning_pose.models import SurfLSTM

    def fail(self: SurfLSTM) -> None:
        if self.hparams["units"] == 4:
            raise RuntimeError("[enforce fail] in [/data/a]")

    monkeypatch.setattr(SurfLSTM, "on_train_epoch_start", fail)
    file = study_file()
    file.write_text(file.read_text().replace("- 4", "- 4\n  - 8"))
    assert workplace.command("sweep", file) == 0
    printed = "".join(capsys.readouterr().out.split())
    assert "[enforcefail]" in printed
    assert "[/data/a]" in printed
