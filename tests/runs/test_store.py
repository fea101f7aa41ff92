"""Tracking stores: created whole by several processes, adapted after a move, and refused when they are not there."""

from __future__ import annotations

import os
import shutil
import socket
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from mlflow import MlflowClient

from lightning_pose.errors import ConfigError
from lightning_pose.runs.logger import MLflowLogger
from lightning_pose.runs.store import prepare_store
from tests.helpers import Workplace
from tests.processes import ForkedProcess


def open_store() -> None:
    """Make a run in the store of the current folder."""
    logger = MLflowLogger()
    logger.client.set_tag(str(logger.run_id), "opened", "yes")
    logger.finalize("success")


def start(folder: Path) -> ForkedProcess:
    return ForkedProcess(open_store, folder=folder, environment={})


def read_statuses(folder: Path) -> list[str]:
    with closing(sqlite3.connect(folder / "mlruns" / "mlflow.db")) as connection:
        return [status for (status,) in connection.execute("SELECT status FROM runs")]


def test_two_first_runs_at_once_share_a_store(tmp_path: Path) -> None:
    processes = [start(tmp_path) for _ in range(2)]
    assert [process.wait() for process in processes] == [0, 0]
    assert read_statuses(tmp_path) == ["FINISHED"] * 2
    assert [file.name for file in (tmp_path / "mlruns").iterdir()] == ["mlflow.db"]


def test_a_store_whose_creation_was_killed_is_created_by_the_next_run(tmp_path: Path) -> None:
    process = start(tmp_path)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("mlruns/.mlflow.db.*.new")):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    time.sleep(0.2)
    process.kill()
    process.wait()
    assert not (tmp_path / "mlruns" / "mlflow.db").exists()
    assert start(tmp_path).wait() == 0
    assert read_statuses(tmp_path) == ["FINISHED"]


@pytest.mark.parametrize("tables", [[], ["CREATE TABLE experiments (experiment_id INTEGER)", "CREATE TABLE runs (a)"]])
def test_a_half_created_store_is_put_aside(tables: list[str], tmp_path: Path) -> None:
    """As `mlflow ui` leaves one that is killed at its first start."""
    file = tmp_path / "mlflow.db"
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA user_version = 1")
        for table in tables:
            connection.execute(table)
    os.utime(file, (0, 0))
    prepare_store(f"sqlite:///{file}")
    assert MlflowClient(f"sqlite:///{file}").search_experiments()
    assert (tmp_path / "mlflow.db.unfinished").is_file()


def test_a_file_that_is_no_database(tmp_path: Path) -> None:
    (tmp_path / "mlflow.db").write_text("no database, but long enough to be one" * 100)
    with pytest.raises(ConfigError, match=r"mlflow.db cannot be used as an MLflow database \(file is not a database\)"):
        MLflowLogger(tracking_uri=f"sqlite:///{tmp_path / 'mlflow.db'}")


def log_file(root: Path, text: str) -> str:
    """Log a text to a run of a store with its artifacts beside it; the run's id."""
    logger = MLflowLogger(root=str(root))
    logger.client.log_text(str(logger.run_id), text, "note.txt")
    logger.finalize("success")
    return str(logger.run_id)


@pytest.mark.parametrize("how", ["moved", "copied"])
def test_artifacts_go_along_with_a_store(how: str, tmp_path: Path, store: Path) -> None:
    old, new = tmp_path / "old" / "mlruns", tmp_path / "new folder" / "mlruns"
    old.mkdir(parents=True)
    shutil.copy(store, old / "mlflow.db")
    first = log_file(old, "first")
    new.parent.mkdir()
    (shutil.move if how == "moved" else shutil.copytree)(old, new)
    second = log_file(new, "second")
    client = MlflowClient(f"sqlite:///{new / 'mlflow.db'}")
    for run, text in ((first, "first"), (second, "second")):
        assert Path(client.download_artifacts(run, "note.txt")).read_text() == text
        assert (new / "artifacts" / run / "artifacts" / "note.txt").read_text() == text
    assert old.exists() == (how == "copied")
    assert not (old / "artifacts" / second).exists()


def test_artifacts_that_are_elsewhere_on_purpose_stay(tmp_path: Path, store: Path) -> None:
    """The store has been given by its address, and the artifacts are in the project."""
    (tmp_path / "stores").mkdir()
    shutil.copy(store, tmp_path / "stores" / "mlflow.db")
    uri = f"sqlite:///{tmp_path / 'stores' / 'mlflow.db'}"
    for _ in range(2):
        logger = MLflowLogger(root=str(tmp_path / "mlruns"), tracking_uri=uri)
        logger.client.log_text(str(logger.run_id), "text", "note.txt")
        (tmp_path / "stores" / "artifacts").mkdir(exist_ok=True)
        assert (tmp_path / "mlruns" / "artifacts" / str(logger.run_id) / "artifacts" / "note.txt").is_file()


@pytest.fixture
def silent() -> Iterator[int]:
    """A port on which connections are accepted and nothing is answered."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


@pytest.fixture
def closed() -> int:
    """A port on which nothing listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@pytest.mark.parametrize("scheme", ["http://", "https://user:secret@", "postgresql://user:secret@", "mysql+pymysql://"])
def test_a_server_that_is_not_there_ends_fit_in_seconds(
    scheme: str, closed: int, workplace: Workplace, capsys: pytest.CaptureFixture[str]
) -> None:
    started = time.monotonic()
    uri = f"{scheme}127.0.0.1:{closed}"
    assert workplace.run("fit", "--trainer.logger.tracking_uri", uri) == 2
    assert time.monotonic() - started < 10
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: the tracking server")
    assert f"127.0.0.1:{closed} does not answer" in error
    assert "--trainer.logger.tracking_uri or MLFLOW_TRACKING_URI" in error
    assert "secret" not in error


def test_a_server_that_does_not_answer(silent: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "1")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    with pytest.raises(ConfigError, match=f"http://127.0.0.1:{silent} does not answer .*; start it, or give"):
        MLflowLogger(tracking_uri=f"http://127.0.0.1:{silent}")
