"""A study that several processes and machines share: each trial is run once, and lost ones are run again."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import optuna
import pytest
import sqlalchemy
import yaml
from optuna.trial import Trial, TrialState

from lightning_pose.models import SurfLSTM
from lightning_pose.sweeps import storage
from lightning_pose.sweeps import workers as runners
from lightning_pose.sweeps.plan import read_plan
from lightning_pose.sweeps.space import draw_values
from lightning_pose.sweeps.study import SAMPLERS, load_study, open_storage, open_study
from tests.helpers import Workplace
from tests.processes import start_fork_server

SPACE = {
    "model.units": {"type": "int", "low": 4, "high": 40},
    "model.learning_rate": {"type": "float", "low": 1e-4, "high": 1e-2, "log": True},
}


def write(workplace: Workplace, **entries: Any) -> Path:
    """A sweep of the workplace's config."""
    file = workplace.folder / "units.yaml"
    file.write_text(
        yaml.safe_dump({"base": "tiny.yaml", "settings": {"trainer.max_epochs": 1}, "space": SPACE} | entries)
    )
    return file


def address(workplace: Workplace) -> str:
    return f"sqlite:///{workplace.folder / 'mlruns' / 'optuna.db'}"


def load(workplace: Workplace) -> optuna.Study:
    return optuna.load_study(study_name="units-wall", storage=address(workplace))


def test_two_commands_run_each_grid_point_once(workplace: Workplace) -> None:
    units = [4, 5, 6, 7]
    file = write(workplace, sampler="grid", space={"model.units": units})
    for command in [workplace.fork("sweep", file) for _ in range(2)]:
        _, errors = command.communicate(timeout=200)
        assert command.returncode == 0, errors
    trials = load(workplace).trials
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 4
    assert sorted(trial.params["model.units"] for trial in trials) == units
    parents = [run for run in workplace.runs() if "mlflow.parentRunId" not in run.data.tags]
    assert len(parents) == 1


@pytest.mark.parametrize("workers", [1, 2])
def test_grid_points_that_others_take_are_not_replaced(
    workers: int, workplace: Workplace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A command that begins with three grid points, of which another takes two at once, runs one and nothing else."""
    name = "run_here" if workers == 1 else "run_in_processes"
    run = getattr(runners, name)

    def run_the_rest(*args: Any) -> None:
        study = load(workplace)
        for _ in range(2):
            study.tell(study.ask(), 1.0)
        run(*args)

    monkeypatch.setattr(runners, name, run_the_rest)
    start_fork_server()
    file = write(workplace, sampler="grid", space={"model.units": [4, 5, 6]})
    assert workplace.command("sweep", file, "--workers", str(workers)) == 0
    assert "trial 1/3" in capsys.readouterr().err
    assert [trial.state for trial in load(workplace).trials] == [TrialState.COMPLETE] * 3


def of_another_machine(workplace: Workplace, minutes: int) -> tuple[int, str]:
    """A trial that runs elsewhere, whose last heartbeat is so many minutes old; its number and MLflow run."""
    storage = open_storage(address(workplace), workplace.uri)
    study = optuna.load_study(study_name="units-wall", storage=storage)
    trial = study.ask()
    trial.suggest_int("model.units", 4, 40)
    (parent,) = (run for run in workplace.runs() if "mlflow.parentRunId" not in run.data.tags)
    tags = {"mlflow.parentRunId": parent.info.run_id, "sweep.trial": str(trial.number)}
    run = workplace.client.create_run(parent.info.experiment_id, tags=tags).info.run_id
    trial.set_user_attr("process", "elsewhere:7")
    trial.set_user_attr("mlflow_run", run)
    trial_id = storage.get_trial_id_from_study_id_trial_number(
        storage.get_study_id_from_name("units-wall"), trial.number
    )
    storage.record_heartbeat(trial_id)
    with storage.engine.begin() as connection:
        moved = f"UPDATE trial_heartbeats SET heartbeat = datetime('now', '-{minutes} minutes') WHERE trial_id = :trial"
        assert connection.execute(sqlalchemy.text(moved), {"trial": trial_id}).rowcount == 1
    return trial.number, run


def test_a_trial_without_heartbeats_is_run_again(workplace: Workplace, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["sweep", write(workplace), "--n_trials", "1"]
    assert workplace.command(*command) == 0
    silent, silent_run = of_another_machine(workplace, minutes=5)
    busy, busy_run = of_another_machine(workplace, minutes=0)
    capsys.readouterr()
    assert workplace.command(*command) == 0
    assert "the process of trial 1 sent no heartbeat; it is run again as trial 3" in capsys.readouterr().err
    trials = load(workplace).trials
    assert [trial.state.name for trial in trials] == ["COMPLETE", "FAIL", "RUNNING", "COMPLETE"]
    assert trials[3].params["model.units"] == trials[silent].params["model.units"]
    assert trials[3].user_attrs["mlflow_run"] != silent_run
    assert (silent, busy) == (1, 2)
    runs = {run.info.run_id: run for run in workplace.runs()}
    assert runs[silent_run].info.status == "KILLED"
    assert runs[silent_run].data.tags["sweep.reason"] == "its process sent no heartbeat"
    assert runs[busy_run].info.status == "RUNNING"


def test_a_study_s_run_ends_with_the_last_command_that_works_at_it(workplace: Workplace) -> None:
    def status() -> str:
        (parent,) = (run for run in workplace.runs() if "mlflow.parentRunId" not in run.data.tags)
        return parent.info.status

    command = ["sweep", write(workplace), "--n_trials", "1"]
    assert workplace.command(*command) == 0
    assert status() == "FINISHED"
    busy, _ = of_another_machine(workplace, minutes=0)
    assert workplace.command(*command) == 0
    assert status() == "RUNNING"
    load(workplace).tell(busy, 1.0)
    assert workplace.command(*command) == 0
    assert status() == "FINISHED"


def test_a_trial_sends_heartbeats_while_it_trains(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> None:
    heartbeats: set[str] = set()

    def wait_for_two(self: SurfLSTM) -> None:
        with sqlalchemy.create_engine(address(workplace)).connect() as connection:
            deadline = time.monotonic() + 20
            while len(heartbeats) < 2 and time.monotonic() < deadline:
                heartbeats.update(
                    connection.execute(sqlalchemy.text("SELECT heartbeat FROM trial_heartbeats")).scalars()
                )
                connection.rollback()
                time.sleep(0.1)

    monkeypatch.setattr(storage, "HEARTBEAT_SECONDS", 1)
    monkeypatch.setattr(SurfLSTM, "on_train_epoch_start", wait_for_two)
    assert workplace.command("sweep", write(workplace), "--n_trials", "1") == 0
    assert len(heartbeats) >= 2


def test_a_trial_that_another_process_has_failed_does_not_end_the_sweep(
    workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a machine that was suspended while another queued its trial again."""
    taken: list[int] = []

    def take(self: SurfLSTM) -> None:
        if not taken:
            taken.append(0)
            load(workplace).tell(0, state=TrialState.FAIL)

    monkeypatch.setattr(SurfLSTM, "on_train_epoch_start", take)
    assert workplace.command("sweep", write(workplace), "--n_trials", "2") == 0
    assert [trial.state.name for trial in load(workplace).trials] == ["FAIL", "COMPLETE"]


OPTIONS: dict[str, dict[str, Any]] = {
    "cmaes": {"n_startup_trials": 2},
    "gp": {"n_startup_trials": 2},
    "nsga2": {"population_size": 4},
    "nsga3": {"population_size": 4},
    "tpe": {"n_startup_trials": 2},
}


@pytest.mark.parametrize("name", sorted(set(SAMPLERS) - {"grid"}))
def test_every_sampler_samples(name: str, workplace: Workplace) -> None:
    file = write(workplace, sampler={"name": name} | OPTIONS.get(name, {}))
    plan = read_plan(file, {})
    storage = open_storage(address(workplace), workplace.uri)
    open_study(plan, "units-wall", storage)
    study = load_study(plan, "units-wall", storage)

    def objective(trial: Trial) -> float:
        values = draw_values(trial, plan.space)
        return values["model.units"] * values["model.learning_rate"]

    study.optimize(objective, n_trials=6)
    assert type(study.sampler) is SAMPLERS[name]
    drawn = {(trial.params["model.units"], trial.params["model.learning_rate"]) for trial in study.trials}
    assert len(drawn) == 6
    assert all(4 <= units <= 40 and 1e-4 <= rate <= 1e-2 for units, rate in drawn)


def test_cma_es_on_the_command_line(workplace: Workplace) -> None:
    file = write(workplace, sampler={"name": "cmaes", "n_startup_trials": 1})
    assert workplace.command("sweep", file, "--n_trials", "3") == 0
    trials = load(workplace).trials
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 3
    assert [any(name.startswith("cma:") for name in trial.system_attrs) for trial in trials] == [False, True, True]


def test_the_dashboard_shows_a_study(workplace: Workplace) -> None:
    pytest.importorskip("optuna_dashboard", reason="`uv sync --extra sweep` installs optuna-dashboard")
    assert workplace.command("sweep", write(workplace), "--n_trials", "2") == 0
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    program = Path(sys.executable).with_name("optuna-dashboard")
    words = [program, "sqlite:///mlruns/optuna.db", "--host", "127.0.0.1", "--port", str(port)]
    with subprocess.Popen(words, cwd=workplace.folder, stderr=subprocess.PIPE) as server:
        try:
            page = f"http://127.0.0.1:{port}"
            assert b"<title>Optuna Dashboard</title>" in fetch(f"{page}/dashboard", server)
            (study,) = json.loads(fetch(f"{page}/api/studies", server))["study_summaries"]
            assert study["study_name"] == "units-wall"
            shown = json.loads(fetch(f"{page}/api/studies/{study['study_id']}?after=0", server))
            assert [trial["state"] for trial in shown["trials"]] == ["Complete", "Complete"]
            assert [t["values"][0] for t in shown["trials"]] == [t.value for t in load(workplace).trials]
            assert shown["objective_names"] == ["val/loss"]
            assert {p["name"] for p in shown["trials"][0]["params"]} == SPACE.keys()
        finally:
            server.terminate()


def fetch(url: str, server: subprocess.Popen[bytes]) -> bytes:
    """What a server answers, once it is there."""
    deadline = time.monotonic() + 60
    while True:
        try:
            with urllib.request.urlopen(url, timeout=20) as answer:
                return answer.read()
        except urllib.error.HTTPError:
            raise
        except OSError:
            assert server.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.1)
