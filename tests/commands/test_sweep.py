"""The verb sweep on a tiny scene: studies, their runs, their results, and how they are continued."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
import yaml
from mlflow.entities import Run
from optuna.trial import TrialState

from lightning_pose.sweeps.plan import read_plan
from lightning_pose.sweeps.storage import hide_password
from lightning_pose.sweeps.trial import EpochWatch
from tests.helpers import REPOSITORY, Workplace
from tests.processes import start_fork_server

CONFIGS = sorted((REPOSITORY / "configs").glob("*.yaml"))
SWEEPS = sorted((REPOSITORY / "sweeps").rglob("*.yaml"))
UNITS = {"model.units": {"type": "int", "low": 4, "high": 40}}
SHORT = {"trainer.max_epochs": 1}
Sweep = Callable[..., Path]


@pytest.fixture
def sweep_file(workplace: Workplace) -> Sweep:
    """Write a sweep of the workplace's config."""

    def write(**entries: Any) -> Path:
        file = workplace.folder / "units.yaml"
        file.write_text(yaml.safe_dump({"base": "tiny.yaml", "settings": SHORT, "space": UNITS} | entries))
        return file

    return write


def trials(workplace: Workplace) -> list[optuna.trial.FrozenTrial]:
    storage = f"sqlite:///{workplace.folder / 'mlruns' / 'optuna.db'}"
    return optuna.load_study(study_name="units-wall", storage=storage).trials


def parent_and_children(workplace: Workplace) -> tuple[Run, list[Run]]:
    runs = workplace.runs()
    (parent,) = (run for run in runs if "mlflow.parentRunId" not in run.data.tags)
    children = [run for run in runs if run is not parent]
    assert {run.data.tags["mlflow.parentRunId"] for run in children} == {parent.info.run_id}
    return parent, children


def setting(config: dict[str, Any], key: str) -> Any:
    """One value of a config file's content, by its dotted name without `init_args`."""
    node: Any = config
    *above, last = key.split(".")
    for part in above:
        node = node[part] if part in node else node["init_args"][part]
    return node[last] if last in node else node["init_args"][last]


@pytest.mark.parametrize("file", SWEEPS, ids=lambda path: path.stem)
def test_every_sweep_file_fits_its_base_config(file: Path) -> None:
    plan = read_plan(file, {"data.root": "somewhere/fire"})
    first = {parameter.key: parameter.example()[0] for parameter in plan.space if not parameter.when}
    config = plan.config(first)
    assert setting(config, "data.root") == "somewhere/fire"
    for key, value in first.items():
        if key != "base":
            assert setting(config, key) == value
    assert plan.scene == "fire"
    assert file.read_text().startswith("# "), "a sweep says what it searches"


def test_a_class_can_be_searched_with_its_own_settings(sweep_file: Sweep) -> None:
    orb, surf = "lightning_pose.features.ORB", "lightning_pose.features.SURF"
    space = {
        "data.extractor.class_path": [orb, surf],
        "data.extractor.fast_threshold": {"choices": [5], "when": {"data.extractor.class_path": orb}},
    }
    plan = read_plan(sweep_file(space=space), {"model": "lightning_pose.models.GraphPose"})
    config = plan.config({"data.extractor.class_path": orb, "data.extractor.fast_threshold": 5})
    assert config["data"]["init_args"]["extractor"] == {"class_path": orb, "init_args": {"fast_threshold": 5}}
    assert config["model"]["class_path"] == "lightning_pose.models.GraphPose"
    assert config["model"]["init_args"] == {"learning_rate": 0.01, "schedule": "constant"}, "no units, no layers"


def test_a_password_is_not_shown() -> None:
    assert hide_password("postgresql://ada:secret@host/db") == "postgresql://ada:***@host/db"


def test_every_architecture_has_a_sweep_file() -> None:
    assert {file.stem for file in CONFIGS} - {"quickstart"} == {
        file.stem for file in SWEEPS if file.parent.name == "sweeps"
    }


def test_the_thesis_has_its_studies() -> None:
    numbers = {2: (1, 2, 4, 5, 6), 3: (4, 5, 6), 4: (3, 4, 5, 6, 7), 5: (2, 3, 4), 6: (4, 6)}
    figures = {f"figure_{chapter}_{i}" for chapter, held in numbers.items() for i in held}
    studies = figures | {"table_3_1", "table_3_3", "table_5_1"}
    assert studies == {file.stem for file in SWEEPS if file.parent.name == "thesis"}


def test_a_sweep_leaves_runs_and_a_config_that_trains_and_goes_on(
    workplace: Workplace, sweep_file: Sweep, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["sweep", sweep_file(objective="val/position_median_m"), "--n_trials", "2"]
    assert workplace.command(*command) == 0
    printed = capsys.readouterr()
    assert "trial 2/2  best val/position_median_m" in printed.err
    assert "2 complete" in printed.out
    parent, children = parent_and_children(workplace)
    assert [run.info.status for run in (parent, *children)] == ["FINISHED"] * 3
    by_number = {trial.number: trial for trial in trials(workplace)}
    for run in children:
        trial = by_number[int(run.data.tags["sweep.trial"])]
        assert run.info.run_name == f"SurfLSTM wall N=6 trial {trial.number}"
        assert run.data.params["model.units"] == str(trial.params["model.units"])
        assert run.data.metrics["val/position_median_m"] == pytest.approx(trial.value)
        assert not any(name.startswith(("test/", "baseline/")) for name in run.data.metrics), "test frames chose"
    assert {run.data.params["model.units"] for run in children} == {
        str(trial.params["model.units"]) for trial in by_number.values()
    }
    best = min(by_number.values(), key=lambda trial: trial.value or np.inf)
    folder = workplace.folder / "mlruns" / "sweeps" / "units-wall"
    config = yaml.safe_load((folder / "best.yaml").read_text())
    assert config["model"]["init_args"]["units"] == best.params["model.units"]
    assert config["trainer"]["max_epochs"] == 1
    description = parent.data.tags["mlflow.note.content"]
    assert "2 complete" in description
    assert f"| {best.number} | {best.value:.4g} | units {best.params['model.units']} |" in description
    kept = {file.path for folder in (None, "figures") for file in
            workplace.client.list_artifacts(parent.info.run_id, folder)}  # fmt: skip
    assert {"best.yaml", "units.yaml", "tiny.yaml", "figures/history.png", "figures/slice.png"} <= kept
    assert {path.name for path in folder.glob("*.png")} >= {"history.png", "parallel_coordinate.png", "importance.png"}

    assert workplace.command(*command) == 0
    assert [trial.state for trial in trials(workplace)] == [TrialState.COMPLETE] * 4
    assert len({trial.params["model.units"] for trial in trials(workplace)}) > 2, "the sampler draws the same again"
    again, children = parent_and_children(workplace)
    assert (again.info.run_id, again.info.status, len(children)) == (parent.info.run_id, "FINISHED", 4)

    assert workplace.command("fit", "--config", folder / "best.yaml") == 0
    best = min(trials(workplace), key=lambda trial: trial.value or np.inf)
    fitted = workplace.runs()[0]
    assert fitted.data.params["model.units"] == str(best.params["model.units"])
    assert fitted.data.metrics["val/position_median_m"] == pytest.approx(best.value or 0, rel=1e-4)


def test_a_trial_has_the_value_of_the_epoch_that_fit_keeps(workplace: Workplace, sweep_file: Sweep) -> None:
    settings = {"trainer.max_epochs": 6, "model.learning_rate": 0.3, "best.monitor": "val/orientation_median_deg"}
    file = sweep_file(objective="val/position_median_m", pruner="none", settings=settings)
    assert workplace.command("sweep", file, "--n_trials", "1") == 0
    (trial,) = trials(workplace)
    assert (
        workplace.command("fit", "--config", workplace.folder / "mlruns" / "sweeps" / "units-wall" / "best.yaml") == 0
    )
    fitted = workplace.runs()[0]
    assert trial.value == pytest.approx(fitted.data.metrics["best/val/position_median_m"], rel=1e-4)


def test_the_epoch_is_chosen_by_the_monitor_and_not_by_the_objective(sweep_file: Sweep) -> None:
    plan = read_plan(sweep_file(objective="val/position_median_m"), {})
    watch = EpochWatch(plan, optuna.trial.create_trial(value=0.0))  # type: ignore[arg-type]
    watch.epochs = [
        {"val/loss": 0.9, "val/position_median_m": 0.1},
        {"val/loss": 0.5, "val/position_median_m": 0.3},
        {"val/loss": float("nan"), "val/position_median_m": 0.2},
    ]
    assert watch.values() == watch.epochs[1]
    watch.monitor = "val/position_median_m"
    assert watch.values() == watch.epochs[0]


def test_a_grid_ends_and_a_trial_that_fails_does_not_end_it(
    workplace: Workplace, sweep_file: Sweep, capsys: pytest.CaptureFixture[str]
) -> None:
    space = {"model.units": [0, 8], "model.cell": {"choices": ["gru", "rnn"], "when": {"model.units": 8}}}
    command = ["sweep", sweep_file(sampler="grid", space=space)]
    assert workplace.command(*command, "--n_trials", "1") == (0 if trials(workplace)[0].value else 2)
    assert workplace.command(*command) == 0
    assert workplace.command(*command) == 0, "there is nothing left"
    outcome = {tuple(trial.params.values()): trial for trial in trials(workplace)}
    assert len(trials(workplace)) == 3
    assert {params: trial.state for params, trial in outcome.items()} == {
        (0,): TrialState.FAIL,
        (8, "gru"): TrialState.COMPLETE,
        (8, "rnn"): TrialState.COMPLETE,
    }
    assert outcome[(0,)].user_attrs["reason"].startswith("units is 0; give 1 or more")
    assert "failed: units is 0" in capsys.readouterr().out.replace("\n", " ")
    _, children = parent_and_children(workplace)
    (failed,) = (run for run in children if run.info.status == "FAILED")
    assert failed.data.tags["sweep.state"] == "FAILED"
    assert failed.data.tags["sweep.reason"].startswith("units is 0")


def test_a_hopeless_trial_is_pruned(workplace: Workplace, sweep_file: Sweep) -> None:
    pruner = {"name": "threshold", "upper": 1e-6}
    file = sweep_file(pruner=pruner, settings={"trainer.max_epochs": 3})
    assert workplace.command("sweep", file, "--n_trials", "1") == 2, "no trial has a value"
    (trial,) = trials(workplace)
    assert trial.state == TrialState.PRUNED
    assert len(trial.intermediate_values) == 1
    _, (run,) = parent_and_children(workplace)
    assert (run.info.status, run.data.tags["sweep.state"]) == ("KILLED", "PRUNED")
    assert "after epoch 1" in run.data.tags["sweep.reason"]


def test_two_objectives_have_a_pareto_front(workplace: Workplace, sweep_file: Sweep) -> None:
    file = sweep_file(objective=["val/position_median_m", "cost/parameters"], sampler="nsga2")
    assert workplace.command("sweep", file, "--n_trials", "2", "--out", workplace.folder / "out") == 0
    by_units = sorted(trials(workplace), key=lambda trial: trial.params["model.units"])
    parameters = [trial.values[1] for trial in by_units]
    assert parameters == sorted(parameters)
    assert (workplace.folder / "out" / "pareto_front.png").is_file()
    assert (workplace.folder / "out" / "best.yaml").is_file()


def test_workers_share_a_study_and_one_is_killed(
    workplace: Workplace, sweep_file: Sweep, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exactly the points of the grid, each once, although a worker is killed in the middle of a trial."""
    killer = {"class_path": "tests.helpers.KillOnce", "init_args": {"marker": str(workplace.folder / "killed")}}
    settings = {"trainer.max_epochs": 2, "trainer.callbacks": [killer]}
    file = sweep_file(sampler="grid", space={"model.units": [4, 5, 6]}, settings=settings, pruner="none")
    start_fork_server()
    assert workplace.command("sweep", file, "--workers", "2") == 0
    errors = capsys.readouterr().err
    assert "trial 3/3" in errors
    assert re.search(r"^the process of trial \d died; it is run again as trial 3$", errors, re.MULTILINE)
    complete = [trial for trial in trials(workplace) if trial.state == TrialState.COMPLETE]
    (dead,) = (trial for trial in trials(workplace) if trial.state != TrialState.COMPLETE)
    assert sorted(trial.params["model.units"] for trial in complete) == [4, 5, 6]
    assert (dead.state, dead.user_attrs["reason"]) == (TrialState.FAIL, "its process died")
    assert len({trial.user_attrs["process"] for trial in trials(workplace)}) in (2, 3)
    _, children = parent_and_children(workplace)
    assert sorted(run.info.status for run in children) == ["FINISHED"] * 3 + ["KILLED"]
    (killed,) = (run for run in children if run.info.status == "KILLED")
    assert killed.data.tags["sweep.reason"] == "its process died"


def test_an_interrupted_trial_is_run_again(
    workplace: Workplace, sweep_file: Sweep, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from lightning_pose.models import SurfLSTM

    before = signal.getsignal(signal.SIGINT)

    def press(self: SurfLSTM) -> None:
        raise KeyboardInterrupt

    file = sweep_file()
    with monkeypatch.context() as patch:
        patch.setattr(SurfLSTM, "on_train_epoch_start", press)
        try:
            assert workplace.command("sweep", file, "--n_trials", "1") == 130
        finally:
            signal.signal(signal.SIGINT, before)
    assert "the same command goes on" in capsys.readouterr().err
    assert [trial.state for trial in trials(workplace)] == [TrialState.FAIL, TrialState.WAITING]
    assert workplace.command("sweep", file, "--n_trials", "1") == 0
    first, second = trials(workplace)
    assert second.state == TrialState.COMPLETE
    assert second.params == first.params
    parent, children = parent_and_children(workplace)
    assert [parent.info.status, *sorted(run.info.status for run in children)] == ["FINISHED", "FINISHED", "KILLED"]


MISTAKES = {
    "unknown key": ({"space": {"model.unit": [1]}}, "space.model.unit is no setting .*did you mean model.units"),
    "wrong value": ({"space": {"model.cell": ["lsmt"]}}, "space.model.cell cannot be 'lsmt'"),
    "unknown type": ({"space": {"model.units": {"type": "integer"}}}, "space.model.units has type 'integer'; did you"),
    "low above high": ({"space": {"model.units": {"type": "int", "low": 9, "high": 2}}}, "low 9 above high 2"),
    "unknown sampler": ({"sampler": "tpee"}, "sampler 'tpee' is not known; did you mean tpe"),
    "unknown pruner": ({"pruner": "medium"}, "pruner 'medium' is not known; did you mean median"),
    "missing base": ({"base": "nowhere.yaml"}, "names the base config nowhere.yaml, which is not there"),
    "test frames": ({"objective": "test/position_median_m"}, "test frames, which must not choose"),
    "unknown objective": ({"objective": "val/position_mean"}, "did you mean val/position_mean_m"),
    "unknown entry": ({"spaces": {}}, "unknown entry 'spaces'; did you mean space"),
    "endless grid": (
        {"sampler": "grid", "space": {"model.dropout": {"type": "float", "low": 0, "high": 0.5}}},
        "model.dropout has no step",
    ),
    "circle": ({"space": {"model.units": {"choices": [1], "when": {"model.units": 1}}}}, "waits for itself"),
}


@pytest.mark.parametrize(("entries", "says"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_one_line_and_leaves_nothing(
    entries: dict[str, Any], says: str, workplace: Workplace, sweep_file: Sweep, capsys: pytest.CaptureFixture[str]
) -> None:
    assert workplace.command("sweep", sweep_file(**entries)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(says, line), line
    assert workplace.runs() == []


def test_a_study_keeps_its_space(workplace: Workplace, sweep_file: Sweep, capsys: pytest.CaptureFixture[str]) -> None:
    assert workplace.command("sweep", sweep_file(space={"model.units": [0]}), "--n_trials", "1") == 2
    assert "no trial of units-wall has ended with a value (1 fail); the last: units is 0" in capsys.readouterr().err
    assert workplace.command("sweep", sweep_file(), "--n_trials", "1") == 2
    assert "exists with another search space" in capsys.readouterr().err
    assert len(trials(workplace)) == 1
