"""BufferedClient: training goes on while the store is gone, and what was to be logged is sent later."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from mlflow import MlflowClient
from mlflow.entities import Metric, Param
from mlflow.exceptions import MlflowException
from mlflow.protos.databricks_pb2 import TEMPORARILY_UNAVAILABLE

from lightning_pose.errors import ConfigError
from lightning_pose.runs import client as client_module
from lightning_pose.runs.client import BufferedClient
from lightning_pose.runs.logger import MLflowLogger
from tests.helpers import Workplace


class Outage:
    """Whether the store is gone; counts what is asked of it meanwhile."""

    def __init__(self) -> None:
        self.on = False
        self.asked = 0

    def wrap(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def ask(*args: Any, **kwargs: Any) -> Any:
            if self.on:
                self.asked += 1
                raise MlflowException("API request failed with exception: connection refused")
            return method(*args, **kwargs)

        return ask


@pytest.fixture
def outage(monkeypatch: pytest.MonkeyPatch) -> Outage:
    outage = Outage()
    for name in ("log_batch", "log_text", "log_artifact", "log_figure", "set_tag", "set_terminated", "update_run"):
        monkeypatch.setattr(MlflowClient, name, outage.wrap(getattr(MlflowClient, name)))
    monkeypatch.setattr(MlflowClient, "get_run", outage.wrap(MlflowClient.get_run))
    return outage


@pytest.fixture
def logger(workplace: Workplace, outage: Outage, monkeypatch: pytest.MonkeyPatch) -> MLflowLogger:
    monkeypatch.chdir(workplace.folder)
    monkeypatch.setattr(client_module, "WAIT_SECONDS", 0.0)
    monkeypatch.setattr(client_module, "SHARE", 0.0)
    return MLflowLogger(tracking_uri=workplace.uri)


def test_what_the_store_did_not_take_is_sent_in_order(
    logger: MLflowLogger, outage: Outage, caplog: pytest.LogCaptureFixture
) -> None:
    run, client = str(logger.run_id), logger.client
    client.get_run(run)
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        outage.on = True
        for epoch in range(3):
            logger.log_metrics({"val/loss": float(epoch)}, step=epoch)
        logger.log_hyperparams({"seed": 3})
        client.set_tag(run, "unit", "m")
        client.log_text(run, "text", "note.txt")
        kept = client.get_run(run).data
        assert (kept.params, kept.tags["unit"]) == ({"seed": "3"}, "m")
        outage.on = False
        logger.log_metrics({"val/loss": 3.0}, step=3)
    assert [metric.value for metric in client.get_metric_history(run, "val/loss")] == [0.0, 1.0, 2.0, 3.0]
    found = client.get_run(run).data
    assert (found.params, found.tags["unit"]) == ({"seed": "3"}, "m")
    assert Path(client.download_artifacts(run, "note.txt")).read_text() == "text"
    gone, back = [record.getMessage() for record in caplog.records]
    assert "does not take what the run logs (API request failed" in gone
    assert "answers again; 5 entries that were kept are sent" in back


def test_a_gap_is_said(
    logger: MLflowLogger, outage: Outage, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = logger.client
    outage.on = True
    logger.log_metrics({"val/loss": 1.0})
    monkeypatch.setattr(client_module, "GONE_SECONDS", 0.0)
    client.finish()
    assert "1 entries (metrics, parameters, files) since" in caplog.text


def test_a_store_that_is_gone_is_not_asked_all_the_time(
    logger: MLflowLogger, outage: Outage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client_module, "WAIT_SECONDS", 60.0)
    assert logger.client
    outage.on = True
    for epoch in range(100):
        logger.log_metrics({"val/loss": 1.0}, step=epoch)
    assert outage.asked == 1


def lock(monkeypatch: pytest.MonkeyPatch, name: str, times: int, now: list[float] | None = None) -> None:
    """Let a method of the store fail so many times as it does when another process has locked the database.

    `now` is a clock, which then goes on by the time that MLflow itself waits.
    """
    method, left = getattr(MlflowClient, name), [times]

    def ask(*args: Any, **kwargs: Any) -> Any:
        if left[0]:
            left[0] -= 1
            if now is not None:
                now[0] += 20
            raise MlflowException("(sqlite3.OperationalError) database is locked", TEMPORARILY_UNAVAILABLE)
        return method(*args, **kwargs)

    monkeypatch.setattr(MlflowClient, name, ask)


@pytest.mark.parametrize("name", ["create_run", "get_experiment_by_name", "search_runs", "get_run"])
def test_a_locked_store_is_waited_for(name: str, workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "LOCKED_PAUSE_SECONDS", 0.0)
    lock(monkeypatch, name, 3)
    logger = MLflowLogger(tracking_uri=workplace.uri, root=str(workplace.folder))
    run = str(logger.run_id)
    assert logger.client.get_run(run).info.status == "RUNNING"
    assert logger.client.get_metric_history(run, "train/loss") == []
    assert [found.info.run_id for found in workplace.runs()] == [run]


def test_a_store_that_stays_locked_takes_no_run(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "LOCKED_SECONDS", 0.0)
    lock(monkeypatch, "get_experiment_by_name", 1000)
    logger = MLflowLogger(tracking_uri=workplace.uri, root=str(workplace.folder))
    with pytest.raises(ConfigError, match=r"takes no run .*database is locked"):
        _ = logger.run_id


def test_a_run_ends_once_its_store_is_unlocked(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    lock(monkeypatch, "set_terminated", 3, now)
    logger = MLflowLogger(tracking_uri=workplace.uri, root=str(workplace.folder))
    run, client = str(logger.run_id), logger.client
    monkeypatch.setattr(client_module.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(client_module.time, "sleep", lambda seconds: None)
    logger.finalize()
    monkeypatch.undo()
    assert client.get_run(run).info.status == "FINISHED"


def test_what_is_wrong_with_a_write_is_raised(logger: MLflowLogger) -> None:
    client = BufferedClient(logger.uri)
    run = str(logger.run_id)
    client.log_batch(run, params=[Param("seed", "1")])
    with pytest.raises(MlflowException, match="Changing param values is not allowed"):
        client.log_batch(run, params=[Param("seed", "2")])
    with pytest.raises(MlflowException, match="not found"):
        client.log_batch("0" * 32, metrics=[Metric("a", 1.0, 0, 0)])


def test_training_goes_on_without_its_store(
    workplace: Workplace, outage: Outage, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is gone from the first epoch on; the run is complete once it is back, in the test."""
    monkeypatch.setattr(client_module, "WAIT_SECONDS", 0.0)
    monkeypatch.setattr(client_module, "SHARE", 0.0)
    monkeypatch.setattr(BufferedClient, "finish", lambda self: None)
    log_metrics = MLflowLogger.log_metrics

    def lose(self: MLflowLogger, metrics: Mapping[str, float], step: int | None = None) -> None:
        outage.on = "baseline/oracle/position_mean_m" not in metrics  # which the test logs towards its end
        log_metrics(self, metrics, step)

    monkeypatch.setattr(MLflowLogger, "log_metrics", lose)
    assert workplace.run("fit") == 0
    assert "oracle" in capsys.readouterr().out
    (run,) = workplace.runs()
    assert run.info.run_name == "SurfLSTM wall N=6"
    assert run.info.status == "FINISHED"
    assert {"train/loss", "val/loss", "test/position_median_m"} <= run.data.metrics.keys()


def test_a_store_that_is_not_locked_is_waited_for_shortly(
    logger: MLflowLogger, outage: Outage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as an SQLite store on a full disk."""
    run = str(logger.run_id)
    outage.on = True
    logger.client.set_tag(run, "unit", "m")
    now = [0.0]
    monkeypatch.setattr(client_module.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(client_module.time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    logger.client.finish()
    assert client_module.GONE_SECONDS <= now[0] < client_module.LOCKED_SECONDS / 2


def test_metrics_that_are_refused_are_not_sent_again(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workplace.folder)
    client = MLflowLogger(tracking_uri=workplace.uri).client
    with client.hold():
        client.log_batch("0" * 32, metrics=[Metric("a", 1.0, 0, 0)])
    with pytest.raises(MlflowException, match="not found"):
        client.send_metrics()
    client.send_metrics()
