"""Runs as an MLflow store keeps them, read from its own tables, because MLflow takes seconds to import.

A database gives a thousand runs in a quarter of a second; a tracking server is asked through MLflow's client.
"""

from __future__ import annotations

import math
import os
import re
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightning_pose.errors import ConfigError

if TYPE_CHECKING:
    from mlflow import MlflowClient

__all__ = ["Run", "masked", "read_runs", "runs_of_client"]

Query = Callable[[str], Iterable[Any]]

VERBS = ("fit", "test")
TABLES = ("experiments", "latest_metrics", "params", "runs", "tags")
METRICS = re.compile(
    r"(test|(best/)?val|baseline/\w+)/(position_median_m|orientation_median_deg)|(best/)?val/loss|test/skill_\w+|cost/\w+"
)
"""The metrics that a report reads; a run has a hundred others."""

ALIASES = {"seed_everything": "seed", "n_features": "data.extractor.n_features"}
"""Settings by the names of the command line, where the store has another."""

LARGEST = 1.7e308  # MLflow keeps infinity as the largest double

_FINISHED = "r.status = 'FINISHED' AND r.lifecycle_stage = 'active' AND e.lifecycle_stage = 'active'"
_MINE = f"""FROM runs r JOIN experiments e ON e.experiment_id = r.experiment_id
JOIN tags v ON v.run_uuid = r.run_uuid AND v.key = 'verb' AND v.value IN ('fit', 'test')
{{join}} WHERE {_FINISHED}"""
_RUNS = f"SELECT r.run_uuid, r.name, e.name, r.start_time {_MINE.format(join='')}"
_VALUES = "SELECT t.run_uuid, t.key, t.value " + _MINE.format(join="JOIN {table} t ON t.run_uuid = r.run_uuid")
_METRICS = (
    "SELECT t.run_uuid, t.key, t.value, t.is_nan "
    + _MINE.format(join="JOIN latest_metrics t ON t.run_uuid = r.run_uuid")
    + " AND (t.key LIKE 'test/%' OR t.key LIKE 'val/%' OR t.key LIKE 'best/val/%' OR t.key LIKE 'cost/%'"
    + " OR t.key LIKE 'baseline/%_median_%')"
)
_STATES = """SELECT v.value, r.status, r.lifecycle_stage FROM runs r
LEFT JOIN tags v ON v.run_uuid = r.run_uuid AND v.key = 'verb'"""


@dataclass(frozen=True)
class Run:
    """A finished run of `fit` or `test`.

    Attributes:
        run_id: MLflow's.
        name: of the run.
        experiment: name of its experiment.
        started: milliseconds since 1970, UTC.
        tags: by name, MLflow's own included.
        params: settings by dotted name.
        metrics: newest value by name; not a number and infinity as such.
    """

    run_id: str
    name: str
    experiment: str
    started: int
    tags: Mapping[str, str]
    params: Mapping[str, str]
    metrics: Mapping[str, float]

    @cached_property
    def settings(self) -> Mapping[str, str]:
        """Tags and parameters by name, and what older runs did not say but follows from these."""
        told = {**self.params, **{name: value for name, value in self.tags.items() if not name.startswith("mlflow.")}}
        if "task" not in told and "data.class_path" in told:
            told["task"] = "relative" if "data.clip_length" in told else "absolute"
        if told.get("task") == "relative":
            for name in ("clip_length", "stride", "relative_frame"):
                if f"data.{name}" in told:
                    told.setdefault(name, told[f"data.{name}"])
        for alias, name in ALIASES.items():
            if name in told:
                told.setdefault(alias, told[name])
        return told

    @property
    def system(self) -> str:
        return self.tags.get("architecture", "unknown")

    @property
    def scene(self) -> str:
        return self.tags.get("scene", "unknown")

    @property
    def features(self) -> str:
        """What the network reads: the extractor, and how many features a frame where that is a setting."""
        count = self.params.get("data.extractor.n_features")
        return self.tags.get("features", "not told") + (f" N={count}" if count else "")

    @property
    def trial(self) -> bool:
        """Whether a sweep ran it."""
        return "sweep.trial" in self.tags or "mlflow.parentRunId" in self.tags

    def __str__(self) -> str:
        return f"{self.name} ({self.run_id[:8]})"


def read_runs(uri: str) -> list[Run]:
    """The finished runs of `fit` and `test` that are not deleted, the newest first.

    Args:
        uri: MLflow's tracking store: `sqlite:///FILE`, the URL of another database, or the address of a server.

    Raises:
        ConfigError: there is no such store, it cannot be read, it is not MLflow's, or it has no such run.
    """
    if uri.startswith(("http://", "https://")):
        runs = _from_server(uri)
    elif re.match(r"\w+(\+\w+)?://", uri) and not uri.startswith("file:"):
        with _open(uri) as query:
            _check_tables(query, uri)
            runs = _from_tables(query)
            if not runs:
                raise ConfigError(_nothing(query, uri))
    else:
        raise ConfigError(
            f"the tracking store {masked(uri)} is no database and no server; give --tracking_uri sqlite:///FILE, "
            "another database's URL, or the http address of an MLflow server"
        )
    if not runs:
        raise ConfigError(
            f"{masked(uri)} has no finished run of fit or test; train with `python -m lightning_pose fit`"
        )
    return sorted(runs, key=lambda run: (run.started, run.run_id), reverse=True)


def masked(text: str) -> str:
    """A store's address, or a text with addresses in it, without passwords."""
    return re.sub(r"(://[^:/@\s]*):\S*@", r"\1:***@", text)


@contextmanager
def _open(uri: str) -> Iterator[Query]:
    """A function that runs one SQL query."""
    if uri.startswith("sqlite:"):
        with _open_sqlite(uri) as query:
            yield query
        return
    # Half a second to import; MLflow brings it.
    from sqlalchemy import create_engine, text
    from sqlalchemy.exc import SQLAlchemyError

    try:
        engine = create_engine(_with_driver(uri))
        with engine.connect() as connection:
            yield lambda sql: connection.execute(text(sql)).fetchall()
    except (SQLAlchemyError, ImportError) as error:
        reason = " ".join(str(getattr(error, "orig", None) or error).split())
        raise ConfigError(f"{masked(uri)} cannot be read ({masked(reason)}); check --tracking_uri") from error


def _with_driver(uri: str) -> str:
    """PostgreSQL's URL with the driver that is installed."""
    bare = re.match(r"postgres(ql)?://", uri)
    if bare and find_spec("psycopg2") is None:
        return "postgresql+psycopg://" + uri[bare.end() :]
    return uri


@contextmanager
def _open_sqlite(uri: str) -> Iterator[Query]:
    file = Path(uri.removeprefix("sqlite:///").partition("?")[0])
    if not uri.startswith("sqlite:///") or not file.is_file():
        raise ConfigError(
            f"{masked(uri)} does not exist; train with `python -m lightning_pose fit`, or say where the runs are with "
            "--tracking_uri sqlite:///FILE or MLFLOW_TRACKING_URI"
        )
    try:
        # Read-only, so that nothing is made or changed; a run that is writing is waited for.
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True, timeout=30)) as connection:
            connection.execute("BEGIN")
            yield connection.execute
    except sqlite3.Error as error:
        raise ConfigError(
            f"{masked(uri)} cannot be read ({error}); give an MLflow database in --tracking_uri"
        ) from error


def _check_tables(query: Query, uri: str) -> None:
    for table in TABLES:
        try:
            query(f"SELECT 1 FROM {table} WHERE 1 = 0")
        except Exception as error:
            if "locked" in str(error):
                raise
            raise ConfigError(
                f"{masked(uri)} is not an MLflow database: it has no table `{table}`; give the one that MLflow "
                "writes, such as --tracking_uri sqlite:///mlruns/mlflow.db"
            ) from error


def _from_tables(query: Query) -> list[Run]:
    runs = list(query(_RUNS))  # before their values: what ends in between is not half read
    values: dict[str, dict[str, dict[str, Any]]] = {}
    for table in ("tags", "params"):
        found = values.setdefault(table, {})
        for run, name, value in query(_VALUES.format(table=table)):
            found.setdefault(run, {})[name] = value
    metrics = values.setdefault("metrics", {})
    for run, name, value, is_nan in query(_METRICS):
        if METRICS.fullmatch(name):
            metrics.setdefault(run, {})[name] = math.nan if is_nan else _finite(value)
    return [
        Run(run, name or "", experiment, started or 0, *(values[part].get(run, {}) for part in values))
        for run, name, experiment, started in runs
    ]


def _finite(value: float) -> float:
    return math.copysign(math.inf, value) if abs(value) > LARGEST else float(value)


def _nothing(query: Query, uri: str) -> str:
    """Why a store has no run to show."""
    rows = query(_STATES)
    told = Counter(f"{verb or 'other'} {'deleted' if stage == 'deleted' else status}" for verb, status, stage in rows)
    has = ", ".join(f"{count} {what}" for what, count in told.most_common()) or "none at all"
    return (
        f"{masked(uri)} has no finished run of fit or test (runs: {has}); "
        "train with `python -m lightning_pose fit --config configs/quickstart.yaml`"
    )


def _from_server(uri: str) -> list[Run]:
    """Ask a tracking server, through MLflow's client, which takes seconds to import."""
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

    # MLflow's own seven retries keep the user waiting for minutes where no server is.
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
    try:
        return runs_of_client(MlflowClient(uri))
    except MlflowException as error:
        reason = str(error).partition("\n")[0]
        raise ConfigError(f"{masked(uri)} does not answer ({masked(reason)}); check --tracking_uri") from error


def runs_of_client(client: MlflowClient, page: int = 1000) -> list[Run]:
    """As `read_runs`, page by page, unsorted."""
    experiments = {e.experiment_id: e.name for e in _pages(lambda token: client.search_experiments(page_token=token))}
    if not experiments:
        return []
    query = "attributes.status = 'FINISHED'"
    found = _pages(lambda token: client.search_runs(list(experiments), query, max_results=page, page_token=token))
    return [
        Run(
            run.info.run_id,
            run.info.run_name or "",
            experiments[run.info.experiment_id],
            run.info.start_time or 0,
            run.data.tags,
            run.data.params,
            {name: _finite(value) for name, value in run.data.metrics.items() if METRICS.fullmatch(name)},
        )
        for run in found
        if run.data.tags.get("verb") in VERBS
    ]


def _pages(ask: Callable[[str | None], Any]) -> Iterator[Any]:
    token = None
    while True:
        answer = ask(token)
        yield from answer
        token = answer.token
        if not token:
            return
