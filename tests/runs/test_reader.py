"""What is read of a store: the same as MLflow's client reads, and errors that say what is wrong with it."""

from __future__ import annotations

import math
import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest

from lightning_pose.errors import ConfigError
from lightning_pose.runs.reader import Run, mask_passwords, read_client_runs, read_runs
from tests.stores import FakeRun, make_store


def plain(run: Run) -> Run:
    """Comparable: MLflow's client adds a tag of its own."""
    tags = {name: value for name, value in run.tags.items() if not name.startswith("mlflow.")}
    return replace(run, tags=tags, params=dict(run.params), metrics=dict(run.metrics))


def test_tables_and_client_agree(tmp_path: Path, store: Path) -> None:
    from mlflow import MlflowClient

    odd = {"cost/parameters": 375807.0, "test/skill_position": math.inf, "baseline/oracle/position_median_m": 0.1}
    runs = [
        FakeRun(metrics=odd, params={"seed": "1"}),
        FakeRun(day=3, tags={"verb": "test"}, experiment="another"),
        FakeRun(day=2, metrics={"train/loss": 1.0, "test/recall_5cm_5deg": 0.5}),
        FakeRun(status="RUNNING"),
        FakeRun(deleted=True),
        FakeRun(tags={"verb": "sweep"}),
    ]
    uri = make_store(tmp_path / "mlflow.db", store, runs)
    found = read_runs(uri)
    assert [run.started for run in found] == sorted((run.started for run in found), reverse=True)
    assert [run.run_id[-1] for run in found] == ["1", "2", "0"]
    assert [run.experiment for run in found] == ["another", "lightning_pose", "lightning_pose"]
    assert found[2].metrics == {**odd, **runs[0].all_metrics}
    assert "train/loss" not in found[1].metrics
    client = read_client_runs(MlflowClient(uri), page=2)
    assert {run.run_id: plain(run) for run in client} == {run.run_id: plain(run) for run in found}


def test_not_a_number_is_read_as_such(tmp_path: Path, store: Path) -> None:
    (run,) = read_runs(make_store(tmp_path / "mlflow.db", store, [FakeRun(test=(math.nan, 3.0), val=math.inf)]))
    assert math.isnan(run.metrics["test/position_median_m"])
    assert run.metrics["val/position_median_m"] == math.inf


def test_other_databases_are_read_through_sqlalchemy(tmp_path: Path, store: Path) -> None:
    runs = [FakeRun(), FakeRun(day=2, params={"seed": "1"})]
    uri = make_store(tmp_path / "mlflow.db", store, runs)
    assert read_runs(uri.replace("sqlite:", "sqlite+pysqlite:")) == read_runs(uri)


def test_old_runs_tell_their_task_by_their_settings(tmp_path: Path, store: Path) -> None:
    clips = {"data.clip_length": "10", "data.stride": "2", "data.relative_frame": "world", "seed": "4"}
    runs = [FakeRun(tags={"task": None}, params=clips), FakeRun(day=2, tags={"task": None})]
    image, clip = read_runs(make_store(tmp_path / "mlflow.db", store, runs))
    assert image.settings["task"] == "absolute"
    assert "clip_length" not in image.settings
    told = {
        name: clip.settings[name] for name in ("task", "clip_length", "stride", "relative_frame", "seed_everything")
    }
    assert told == {
        "task": "relative", "clip_length": "10", "stride": "2", "relative_frame": "world", "seed_everything": "4",
    }  # fmt: skip


def test_no_store(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere.db does not exist; train with .* --tracking_uri"):
        read_runs(f"sqlite:///{tmp_path / 'nowhere.db'}")
    assert not (tmp_path / "nowhere.db").exists(), "asking makes no database"


@pytest.mark.parametrize("uri", ["mlruns", "file:///mlruns", "./mlruns/mlflow.db"])
def test_no_address_of_a_store(uri: str) -> None:
    with pytest.raises(ConfigError, match=f"store {uri} is no database .* sqlite:///FILE"):
        read_runs(uri)


def test_a_database_of_something_else(tmp_path: Path) -> None:
    sqlite3.connect(tmp_path / "optuna.db").execute("CREATE TABLE trials (number INTEGER)").connection.close()
    with pytest.raises(ConfigError, match=r"optuna.db cannot be read as .* .no such table: runs.; check --track"):
        read_runs(f"sqlite:///{tmp_path / 'optuna.db'}")


def test_a_file_that_is_no_database(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no database at all, but long enough to have a header" * 9)
    with pytest.raises(ConfigError, match=r"notes.txt cannot be read as an MLflow database .file is not a database."):
        read_runs(f"sqlite:///{tmp_path / 'notes.txt'}")


def test_nothing_finished_says_what_there_is(tmp_path: Path, store: Path) -> None:
    runs = [FakeRun(status="FAILED"), FakeRun(status="FAILED"), FakeRun(deleted=True), FakeRun(tags={"verb": None})]
    uri = make_store(tmp_path / "mlflow.db", store, runs)
    with pytest.raises(ConfigError, match=r"no finished run .*runs: 2 fit FAILED, 1 fit deleted, 1 other FINISHED"):
        read_runs(uri)


def test_an_unreachable_database_keeps_its_password() -> None:
    uri = "postgresql+psycopg://ada:secret@127.0.0.1:1/mlflow"
    with pytest.raises(
        ConfigError, match=r"postgresql\+psycopg://ada:\*\*\*@127.0.0.1:1/mlflow cannot be read"
    ) as info:
        read_runs(uri)
    assert "secret" not in str(info.value)
    assert mask_passwords("sqlite:///a.db") == "sqlite:///a.db"


@pytest.mark.parametrize(
    ("uri", "says"),
    [
        ("http://ada:secret@localhost:1", r"http://ada:\*\*\*@localhost:1 does not answer \(.*; check --tracking_uri"),
        ("file://ada:secret@host/runs", r"store file://ada:\*\*\*@host/runs is no database and no server"),
        ("nosuch://ada:secret@host/runs", r"nosuch://ada:\*\*\*@host/runs cannot be read"),
        ("sqlite://ada:secret@host/runs.db", r"sqlite://ada:\*\*\*@host/runs.db does not exist"),
    ],
)
def test_no_message_has_a_password(uri: str, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    with pytest.raises(ConfigError, match=says) as info:
        read_runs(uri)
    assert "secret" not in str(info.value)


def test_an_empty_server_keeps_its_password(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lightning_pose.runs.reader.read_client_runs", lambda client: [])
    with pytest.raises(ConfigError, match=r"http://ada:\*\*\*@localhost:5000 has no finished run"):
        read_runs("http://ada:secret@localhost:5000")


def test_passwords_are_masked_to_their_end() -> None:
    assert mask_passwords("http://ada:s@cr/t@host:5000/x") == "http://ada:***@host:5000/x"
    assert mask_passwords("see http://host:5000/a and mail@host") == "see http://host:5000/a and mail@host"
