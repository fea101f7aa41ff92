"""An MLflow store that is locked for a minute, and an MLflow server that is killed and comes back, during `fit`."""

from __future__ import annotations

import socket
import sqlite3
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import psutil
from mlflow import MlflowClient

from benchmarks.abuse.table import Row
from benchmarks.abuse.workplace import Workplace

__all__ = ["try_stores"]

LOCKED_SECONDS = 60

GONE_SECONDS = 20
"""How long a killed server stays away."""

DELAYS = (0.0, 2.0, 5.0)
"""Seconds after the start of `fit`: before it begins, while it trains, and at its end."""

EPOCHS = 30


def try_stores(base: Workplace) -> Iterator[Row]:
    """Lock the store of `fit`, and kill its server; a row each.

    Args:
        base: a workplace.
    """
    if base.wants("lock"):
        found = Counter(_lock_store(base, delay) for delay in DELAYS)
        yield _make_row(f"store locked for {LOCKED_SECONDS} s in `fit`", found)
    if base.wants("server"):
        found = Counter(_kill_server(base, epoch) for epoch in (1, 100, 200))
        yield _make_row(f"MLflow server killed in `fit`, back after {GONE_SECONDS} s", found)


def _make_row(what: str, found: Counter[str]) -> Row:
    bad = {kind: times for kind, times in found.items() if kind != "complete"}
    return Row(what, found.total(), bad, f"{found['complete']} complete")


def _lock_store(base: Workplace, delay: float) -> str:
    """Lock the store for a minute, so long after the start of `fit`."""
    place = base.copy()
    with place.fork("fit", "--config", base.config("refined"), "--trainer.max_epochs", EPOCHS) as process:
        time.sleep(delay)
        locker = threading.Thread(target=_hold_lock, args=(place.folder / "mlruns" / "mlflow.db",))
        locker.start()
        _, errors = process.communicate(400)
        code = process.wait()
        locker.join()
    return _judge(place.uri, code, errors, EPOCHS)


def _hold_lock(file: Path) -> None:
    with closing(sqlite3.connect(file, timeout=30, isolation_level=None)) as connection:
        connection.execute("BEGIN EXCLUSIVE")
        time.sleep(LOCKED_SECONDS)
        connection.execute("COMMIT")


def _kill_server(base: Workplace, epoch: int) -> str:
    """Kill the server once `fit` has logged so many epochs, and start it again while it trains."""
    place, epochs = base.copy(), 1000
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    uri = f"http://127.0.0.1:{port}"
    words = ("fit", "--config", base.config("refined"), "--trainer.max_epochs", epochs)
    words = (*words, "--trainer.logger.tracking_uri", uri)
    with serve_store(place, port):
        process = place.fork(*words)
        client = MlflowClient(uri)
        _wait_for_epoch(client, epoch)
    time.sleep(GONE_SECONDS)
    has_ended = process.poll() is not None
    with process, serve_store(place, port):
        _, errors = process.communicate(500)
        found = _judge(uri, process.wait(), errors, epochs)
    return f"{found}, ended before the server came back" if has_ended else found


@contextmanager
def serve_store(place: Workplace, port: int) -> Iterator[None]:
    """A real MLflow server on this machine, killed outright with its workers at the end."""
    command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(port), "--workers", "1"]
    command += ["--backend-store-uri", place.uri, "--artifacts-destination", str(place.folder / "artifacts")]
    server = subprocess.Popen(command, cwd=place.folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 120
        while not _answers(port):
            assert server.poll() is None, "the MLflow server has ended"
            assert time.monotonic() < deadline, "the MLflow server does not answer"
            time.sleep(0.2)
        yield
    finally:
        with suppress(psutil.NoSuchProcess):
            for process in [*psutil.Process(server.pid).children(recursive=True), psutil.Process(server.pid)]:
                process.kill()
        server.wait()


def _answers(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=2) as answer:
            return answer.status == 200
    except (urllib.error.URLError, OSError):
        return False


def _wait_for_epoch(client: MlflowClient, epoch: int) -> None:
    """Wait until a run has logged so many epochs."""
    deadline = time.monotonic() + 200
    while time.monotonic() < deadline:
        experiment = client.get_experiment_by_name("lightning_pose")
        runs = client.search_runs([experiment.experiment_id]) if experiment else []
        if runs and len(client.get_metric_history(runs[0].info.run_id, "train/loss")) >= epoch:
            return
        time.sleep(0.1)
    raise TimeoutError(f"no run has logged {epoch} epochs")


def _judge(uri: str, code: int, errors: str, epochs: int) -> str:
    """Whether the store has one finished run with its test and every epoch."""
    client = MlflowClient(uri)
    experiment = client.get_experiment_by_name("lightning_pose")
    runs = client.search_runs([experiment.experiment_id]) if experiment else []
    if "Traceback" in errors:
        return "traceback"
    if code != 0 or [run.info.status for run in runs] != ["FINISHED"]:
        return f"exit code {code}, {[run.info.status for run in runs]}"
    if "test/position_median_m" not in runs[0].data.metrics:
        return "no test metrics"
    logged = {metric.step for metric in client.get_metric_history(runs[0].info.run_id, "train/loss")}
    return "complete" if len(logged) == epochs else f"{epochs - len(logged)} epochs missing"
