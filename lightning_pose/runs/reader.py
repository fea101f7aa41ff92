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
from typing import TYPE_CHECKING, Any, TypeVar

from lightning_pose.errors import ConfigError
from lightning_pose.metrics.catalog import MEDIANS, SKILLS

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.store.entities import PagedList

__all__ = ["Run", "mask_passwords", "read_client_runs", "read_pages", "read_runs"]

Item = TypeVar("Item")
Query = Callable[[str], Iterable[Any]]

METRICS = re.compile(
    rf"(test|(best/)?val|baseline/\w+)/({'|'.join(MEDIANS)})|(best/)?val/loss|test/({'|'.join(SKILLS)})|cost/\w+"
)
"""The metrics that a report reads; a run has a hundred others."""

ALIASES = {"seed_everything": "seed", "n_features": "data.extractor.n_features"}
"""Settings by the names of the command line, where the store has another."""

LARGEST = 1.7e308  # MLflow keeps infinity as the largest double

_FINISHED = """FROM runs r JOIN experiments e ON e.experiment_id = r.experiment_id
JOIN tags v ON v.run_uuid = r.run_uuid AND v.key = 'verb' AND v.value IN ('fit', 'test') {join}
WHERE r.status = 'FINISHED' AND r.lifecycle_stage = 'active' AND e.lifecycle_stage = 'active'"""
_RUNS = f"SELECT r.run_uuid, r.name, e.name, r.start_time {_FINISHED.format(join='')}"
_VALUES = "SELECT t.run_uuid, t.key, {columns} " + _FINISHED.format(join="JOIN {table} t ON t.run_uuid = r.run_uuid")
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
        """Tags and parameters by name, and what older runs did not record but follows from these."""
        settings = {
            **self.params,
            **{name: value for name, value in self.tags.items() if not name.startswith("mlflow.")},
        }
        if "task" not in settings and "data.class_path" in settings:
            settings["task"] = "relative" if "data.clip_length" in settings else "absolute"
        if settings.get("task") == "relative":
            for name in ("clip_length", "stride", "relative_frame"):
                if f"data.{name}" in settings:
                    settings.setdefault(name, settings[f"data.{name}"])
        for alias, name in ALIASES.items():
            if name in settings:
                settings.setdefault(alias, settings[name])
        return settings

    @property
    def system(self) -> str:
        return self.tags.get("architecture", "unknown") + " refined" * ("refined" in self.tags)

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
    address, states = mask_passwords(uri), ""
    if uri.startswith(("http://", "https://")):
        runs = _read_server(uri)
    elif re.match(r"\w+(\+\w+)?://", uri) and not uri.startswith("file:"):
        with _open_database(uri) as query:
            runs = _read_tables(query)
            states = "" if runs else f" (runs: {_count_states(query)})"
    else:
        raise ConfigError(
            f"the tracking store {address} is no database and no server; give --tracking_uri sqlite:///FILE, "
            "another database's URL, or the http address of an MLflow server"
        )
    if not runs:
        raise ConfigError(
            f"{address} has no finished run of fit or test{states}; "
            "train with `python -m lightning_pose fit --config configs/quickstart.yaml`"
        )
    return sorted(runs, key=lambda run: (run.started, run.run_id), reverse=True)


def mask_passwords(text: str) -> str:
    """A store's address, or a text with addresses in it, without passwords."""
    return re.sub(r"(://[^:/@\s]*):\S*@", r"\1:***@", text)


@contextmanager
def _open_database(uri: str) -> Iterator[Query]:
    """A function that runs one SQL query; what the database refuses is raised as a `ConfigError`."""
    address = mask_passwords(uri)
    errors: tuple[type[Exception], ...] = (sqlite3.Error, ImportError)
    try:
        if uri.startswith("sqlite:"):
            file = Path(uri.removeprefix("sqlite:///").partition("?")[0])
            if not uri.startswith("sqlite:///") or not file.is_file():
                raise ConfigError(
                    f"{address} does not exist; train with `python -m lightning_pose fit`, or say where the runs are "
                    "with --tracking_uri sqlite:///FILE or MLFLOW_TRACKING_URI"
                )
            # Read-only, so that nothing is made or changed; a run that is writing is waited for.
            with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True, timeout=30)) as connection:
                connection.execute("BEGIN")
                yield connection.execute
        else:
            # Half a second to import; MLflow brings it.
            from sqlalchemy import create_engine, text
            from sqlalchemy.exc import SQLAlchemyError

            errors = (*errors, SQLAlchemyError)
            bare = re.match(r"postgres(ql)?://", uri)
            driven = f"postgresql+psycopg://{uri[bare.end() :]}" if bare and find_spec("psycopg2") is None else uri
            with create_engine(driven).connect() as connection:
                yield lambda sql: connection.execute(text(sql)).fetchall()
    except errors as error:
        reason = mask_passwords(" ".join(str(getattr(error, "orig", None) or error).split()))
        raise ConfigError(
            f"{address} cannot be read as an MLflow database ({reason}); check --tracking_uri: it "
            "takes the one that MLflow writes, such as sqlite:///mlruns/mlflow.db"
        ) from error


def _read_tables(query: Query) -> list[Run]:
    runs = list(query(_RUNS))  # before their values, so that a run that ends in between is not read in part
    tags: dict[str, dict[str, str]] = {}
    params: dict[str, dict[str, str]] = {}
    metrics: dict[str, dict[str, float]] = {}
    for table, values in (("tags", tags), ("params", params)):
        for run, name, value in query(_VALUES.format(table=table, columns="t.value")):
            values.setdefault(run, {})[name] = value
    for run, name, value, is_nan in query(_VALUES.format(table="latest_metrics", columns="t.value, t.is_nan")):
        if METRICS.fullmatch(name):
            metrics.setdefault(run, {})[name] = math.nan if is_nan else _restore_infinity(value)
    return [
        Run(run, name or "", experiment, started or 0, tags[run], params.get(run, {}), metrics.get(run, {}))
        for run, name, experiment, started in runs
    ]


def _restore_infinity(value: float) -> float:
    """The value as it was logged; MLflow keeps infinity as the largest double."""
    return math.copysign(math.inf, value) if abs(value) > LARGEST else float(value)


def _count_states(query: Query) -> str:
    """How many runs the store has of each verb and status, the most frequent first."""
    states = Counter(
        f"{verb or 'other'} {'deleted' if stage == 'deleted' else status}" for verb, status, stage in query(_STATES)
    )
    return ", ".join(f"{count} {state}" for state, count in states.most_common()) or "none at all"


def _read_server(uri: str) -> list[Run]:
    """Ask a tracking server, through MLflow's client, which takes seconds to import."""
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

    # MLflow's own seven retries keep the user waiting for minutes where no server is.
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
    try:
        return read_client_runs(MlflowClient(uri))
    except MlflowException as error:
        address, reason = mask_passwords(uri), mask_passwords(str(error).partition("\n")[0])
        raise ConfigError(f"{address} does not answer ({reason}); check --tracking_uri") from error


def read_client_runs(client: MlflowClient, page: int = 1000) -> list[Run]:
    """As `read_runs`, page by page, unsorted."""
    names = {e.experiment_id: e.name for e in read_pages(lambda token: client.search_experiments(page_token=token))}
    query = "attributes.status = 'FINISHED'"
    found = read_pages(lambda token: client.search_runs(list(names), query, max_results=page, page_token=token))
    return [
        Run(
            run.info.run_id,
            run.info.run_name or "",
            names[run.info.experiment_id],
            run.info.start_time or 0,
            run.data.tags,
            run.data.params,
            {name: _restore_infinity(value) for name, value in run.data.metrics.items() if METRICS.fullmatch(name)},
        )
        for run in (found if names else ())
        if run.data.tags.get("verb") in ("fit", "test")
    ]


def read_pages(ask: Callable[[str | None], PagedList[Item]]) -> Iterator[Item]:
    """All items of an answer that comes in pages, which are asked for by their token."""
    token = None
    while token != "":
        answer = ask(token)
        yield from answer
        token = answer.token or ""
