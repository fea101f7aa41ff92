"""Tracking: where runs go, how they are named and closed, which one goes on, and what MLflow keeps."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from lightning_pose.paths import default_tracking_uri
from lightning_pose.runs.logger import MLflowLogger, flatten_settings
from lightning_pose.runs.process import has_died, identify_machine, process_name
from tests.helpers import Workplace


def dead_process() -> int:
    """The number of a process that is gone."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.fixture
def logger(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> MLflowLogger:
    monkeypatch.chdir(workplace.folder)
    return MLflowLogger(tracking_uri=workplace.uri)


def test_the_environment_names_the_store(monkeypatch: pytest.MonkeyPatch) -> None:
    assert default_tracking_uri() == "sqlite:///mlruns/mlflow.db"
    assert default_tracking_uri("/data/runs") == "sqlite:////data/runs/mlflow.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://tracker:5000")
    assert default_tracking_uri() == "http://tracker:5000"


def test_a_store_named_in_code_is_not_the_next_logger_s(tmp_path: Path, store: Path) -> None:
    for name in ("first", "second"):
        root = tmp_path / name
        root.mkdir()
        shutil.copy(store, root / "mlflow.db")
        logger = MLflowLogger(root=str(root))
        logger.client.set_tag(str(logger.run_id), "made", "by hand")
        assert logger.uri == f"sqlite:///{root}/mlflow.db"
    assert "MLFLOW_TRACKING_URI" not in os.environ


def test_settings_by_dotted_name() -> None:
    spec = {"class_path": "a.Net", "init_args": {"units": 8, "loss": {"form": "joint"}}}
    assert flatten_settings({"model": spec, "seed": 0}) == {
        "model.class_path": "a.Net",
        "model.units": 8,
        "model.loss.form": "joint",
        "seed": 0,
    }


def test_a_run_belongs_to_its_process(logger: MLflowLogger) -> None:
    tags = logger.client.get_run(str(logger.run_id)).data.tags
    assert tags["process.id"] == str(os.getpid())
    logger.finalize("success")
    assert logger.client.get_run(str(logger.run_id)).info.status == "FINISHED"


@pytest.mark.parametrize(
    ("process", "host", "status"),
    [
        ("dead", None, "KILLED"),
        ("alive", None, "RUNNING"),
        ("dead", "another machine", "RUNNING"),
        ("dead", f"{socket.gethostname()} 01234567", "RUNNING"),
    ],
)
def test_runs_whose_process_is_gone_are_closed(
    process: str, host: str | None, status: str, logger: MLflowLogger, workplace: Workplace
) -> None:
    run_id = str(logger.run_id)
    number = dead_process() if process == "dead" else os.getppid()
    logger.client.set_tag(run_id, "process.id", str(number))
    if host:
        logger.client.set_tag(run_id, "process.host", host)
    following = MLflowLogger(tracking_uri=workplace.uri)
    assert following.client.get_run(run_id).info.status == status
    assert following.client.get_run(str(following.run_id)).info.status == "RUNNING"


def test_a_machine_is_more_than_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another boot, or another machine of the same name, has processes of its own under the same numbers."""
    dead = f"{identify_machine()}:{dead_process()}"
    assert has_died(dead)
    assert not has_died(process_name())
    assert identify_machine().split()[0] == socket.gethostname()
    monkeypatch.setattr(Path, "read_text", lambda self: "another boot")
    identify_machine.cache_clear()
    try:
        assert identify_machine().split()[0] == socket.gethostname()
        assert not has_died(dead)
    finally:
        monkeypatch.undo()
        identify_machine.cache_clear()


@pytest.mark.parametrize(("began", "status"), [(1000, "KILLED"), (None, "RUNNING")])
def test_runs_from_before_the_machine_started_are_closed(
    began: int | None, status: str, logger: MLflowLogger, workplace: Workplace
) -> None:
    """As after a power failure; one of its name that began later is another machine's."""
    tags = {"process.host": f"{socket.gethostname()} 01234567", "process.id": str(os.getppid())}
    assert logger.client
    run_id = logger.client.create_run(str(logger.experiment_id), start_time=began, tags=tags).info.run_id
    following = MLflowLogger(tracking_uri=workplace.uri)
    assert following.client.get_run(run_id).info.status == status


@pytest.mark.parametrize(
    ("trial", "status"), [("dead", "KILLED"), ("alive", "RUNNING"), ("of another machine", "RUNNING")]
)
def test_a_sweep_s_run_is_not_closed_while_its_trials_live(
    trial: str, status: str, logger: MLflowLogger, workplace: Workplace
) -> None:
    """As when another command that worked at the study has ended."""
    parent = str(logger.run_id)
    logger.client.set_tag(parent, "process.id", str(dead_process()))
    number = os.getppid() if trial == "alive" else dead_process()
    host = "elsewhere" if trial == "of another machine" else identify_machine()
    tags = {"mlflow.parentRunId": parent, "process.host": host, "process.id": str(number)}
    logger.client.create_run(str(logger.experiment_id), tags=tags)
    following = MLflowLogger(tracking_uri=workplace.uri)
    assert following.client.get_run(parent).info.status == status


def test_a_run_that_goes_on_is_claimed(logger: MLflowLogger, workplace: Workplace) -> None:
    run_id = str(logger.run_id)
    logger.client.set_tag(run_id, "process.id", str(dead_process()))
    resumed = MLflowLogger(tracking_uri=workplace.uri, run_id=run_id)
    assert resumed.client.get_run(run_id).data.tags["process.id"] == str(os.getpid())
    following = MLflowLogger(tracking_uri=workplace.uri)
    assert following.client.get_run(run_id).info.status == "RUNNING"


def test_parameters_of_a_run_that_goes_on_may_differ(logger: MLflowLogger) -> None:
    logger.log_hyperparams({"trainer": {"max_epochs": 2}})
    logger.log_hyperparams({"trainer": {"max_epochs": 4}, "seed": 1})
    assert logger.client.get_run(str(logger.run_id)).data.params == {"trainer.max_epochs": "2", "seed": "1"}
