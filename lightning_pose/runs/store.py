"""MLflow's tracking store before a command uses it: created whole, adapted after a move, refused if it is not there."""

from __future__ import annotations

import logging
import os
import re
import shutil
import socket
import sqlite3
import time
import uuid
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass, url2pathname

from lightning_pose.errors import ConfigError
from lightning_pose.paths import default_tracking_uri
from lightning_pose.runs.reader import mask_passwords

__all__ = ["is_server", "limit_waiting", "prepare_store", "sqlite_file"]

CONNECT_SECONDS = 5.0
"""How long a server may take to accept a connection."""

QUIET_SECONDS = 15.0
"""A store that is not complete, and that nobody has written to for so long, is never completed."""

LOCKED_SECONDS = 60.0
"""How long another process may lock the store."""

PORTS = {"http": 80, "https": 443, "postgresql": 5432, "postgres": 5432, "mysql": 3306, "mssql": 1433}

LOCATIONS = (
    ("experiments", "artifact_location"),
    ("runs", "artifact_uri"),
    ("logged_models", "artifact_location"),
    ("model_versions", "source"),
    ("model_versions", "storage_location"),
)
"""Columns of MLflow's tables that hold places of artifacts; MLflow keeps them as absolute addresses."""

REMEDY = (
    "start it, or give another store with --trainer.logger.tracking_uri or MLFLOW_TRACKING_URI, such as "
    "sqlite:///mlruns/mlflow.db"
)

log = logging.getLogger("lightning_pose")


def prepare_store(uri: str | None = None) -> str:
    """Make a tracking store usable, and return its address.

    An SQLite database that is not there is created. In one whose folder was moved or copied together with the
    artifacts, the artifacts' new places are entered. A server is asked whether it is there.

    Args:
        uri: address; by default `MLFLOW_TRACKING_URI`, or else `sqlite:///mlruns/mlflow.db`.

    Raises:
        ConfigError: the server does not answer, or the database cannot be created or read.
    """
    uri = uri or default_tracking_uri()
    file = sqlite_file(uri)
    if file is not None:
        try:
            _prepare_database(file)
        except (OSError, sqlite3.Error) as error:
            raise ConfigError(f"{file} cannot be used as an MLflow database ({error}); check {uri}") from error
    elif is_server(uri):
        limit_waiting()
        _check_server(uri)
    elif re.match(r"\w+(\+\w+)?://", uri) and not uri.startswith(("file:", "sqlite:")):
        _check_database(uri)
    return uri


def sqlite_file(uri: str) -> Path | None:
    """The file of an SQLite store; None for any other store."""
    path = uri.removeprefix("sqlite:///").partition("?")[0]
    return Path(path) if uri.startswith("sqlite:///") and path not in ("", ":memory:") else None


def is_server(uri: str) -> bool:
    """Whether an address is that of an MLflow server."""
    return uri.startswith(("http://", "https://"))


def limit_waiting() -> None:
    """Set how long MLflow waits for a server, unless the user has: its own defaults keep a user waiting for minutes."""
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR", "1")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "15")


def _check_server(uri: str) -> None:
    """Ask an MLflow server for an experiment.

    Raises:
        ConfigError: nothing answers within some seconds, or what answers is no MLflow server.
    """
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

    if not _is_proxied(uri):
        _check_port(uri)
    try:
        MlflowClient(uri).search_experiments(max_results=1)
    except (MlflowException, OSError, ValueError) as error:
        reason = mask_passwords(str(error).partition("\n")[0])[:200]
        raise ConfigError(f"the tracking server {mask_passwords(uri)} does not answer ({reason}); {REMEDY}") from error


def _is_proxied(uri: str) -> bool:
    """Whether requests to an address go through a proxy."""
    parts = urlsplit(uri)
    return parts.scheme in getproxies() and not proxy_bypass(parts.hostname or "")


def _check_port(uri: str) -> None:
    """Raise ConfigError if the host of an address does not accept a connection."""
    try:
        parts = urlsplit(uri)
        port = parts.port or PORTS.get(parts.scheme.partition("+")[0])
        if not parts.hostname or port is None:
            return  # a socket of this machine, or a database with a port that only its driver knows
        socket.create_connection((parts.hostname, port), CONNECT_SECONDS).close()
    except (OSError, ValueError) as error:  # a port that is no number, too
        raise ConfigError(f"the tracking server {mask_passwords(uri)} does not answer ({error}); {REMEDY}") from error


def _check_database(uri: str) -> None:
    """Raise ConfigError if a database server cannot be connected to; MLflow would try for minutes."""
    from sqlalchemy import create_engine
    from sqlalchemy.exc import SQLAlchemyError

    _check_port(uri)
    try:
        engine = create_engine(uri)
        engine.connect().close()
        engine.dispose()
    except (SQLAlchemyError, ImportError) as error:
        reason = mask_passwords(" ".join(str(getattr(error, "orig", None) or error).split()))[:200]
        raise ConfigError(f"the tracking store {mask_passwords(uri)} cannot be used ({reason}); {REMEDY}") from error


def _prepare_database(file: Path) -> None:
    """Create an SQLite store that is missing or was never completed; enter the artifacts' places in one that moved.

    Raises:
        OSError: it cannot be created.
        sqlite3.Error: it is no database.
    """
    while not _is_complete(file):
        if not file.is_file():
            _create_database(file)
        elif _count_quiet_seconds(file) > QUIET_SECONDS:
            # Another program, such as `mlflow ui`, creates it table by table. Killed, it leaves what nobody can open.
            for part in _list_parts(file):
                part.replace(part.with_name(f"{part.name}.unfinished"))
        else:
            time.sleep(0.2)
    _enter_places(file)


def _list_parts(file: Path) -> list[Path]:
    """The files of an SQLite database, its log of changes first."""
    parts = (file.with_name(f"{file.name}{ending}") for ending in ("-journal", "-wal", "-shm", ""))
    return [part for part in parts if part.exists()]


def _count_quiet_seconds(file: Path) -> float:
    """Seconds since a database was last written to."""
    return time.time() - max((part.stat().st_mtime for part in _list_parts(file)), default=0.0)


def _is_complete(file: Path) -> bool:
    """Whether an SQLite file is a store that MLflow has finished creating: its default experiment comes last."""
    if not file.is_file() or file.stat().st_size == 0:
        return False
    with closing(sqlite3.connect(file, timeout=LOCKED_SECONDS)) as connection:
        try:
            return bool(connection.execute("SELECT count(*) FROM experiments").fetchone()[0])
        except sqlite3.OperationalError as error:
            if "no such table" in str(error):
                return False
            raise


def _create_database(file: Path) -> None:
    """Create an SQLite store under a temporary name, and give it its name once it is whole.

    A process that is killed meanwhile leaves a temporary file; of several at the same time, the first one's is kept.
    """
    from mlflow import MlflowClient

    file.parent.mkdir(parents=True, exist_ok=True)
    new = file.with_name(f".{file.name}.{uuid.uuid4().hex[:8]}.new")
    copy = new.with_suffix(".copy")
    try:
        MlflowClient(f"sqlite:///{new}").search_experiments()
        shutil.copyfile(new, copy)  # MLflow keeps a connection to `new`, under that name
        _name_if_free(copy, file)
    finally:
        for temporary in (*_list_parts(new), copy):
            temporary.unlink(missing_ok=True)
    for abandoned in file.parent.glob(f".{file.name}.*"):
        with suppress(OSError):  # another process may delete it first
            if time.time() - abandoned.stat().st_mtime > 3600:
                abandoned.unlink()


def _name_if_free(temporary: Path, file: Path) -> None:
    """Give a file its name, unless another process has given it to its own."""
    try:
        file.hardlink_to(temporary)
    except FileExistsError:
        pass
    except OSError:  # a file system without hard links
        if not file.exists():
            temporary.rename(file)


def _enter_places(file: Path) -> None:
    """In a store that was moved or copied together with its artifacts, replace their old places by the new ones.

    `fit` keeps artifacts in a folder beside the database. Where MLflow names another folder of that name, and the
    one beside the database has a run's artifacts or the other one's folder is gone, the two have moved.
    """
    folder = file.resolve().parent / "artifacts"
    with closing(sqlite3.connect(file, timeout=LOCKED_SECONDS)) as connection:
        places = connection.execute("SELECT experiment_id, artifact_location FROM experiments").fetchall()
        for experiment, place in places:
            old = _local_path(place or "")
            if old is None or old.name != folder.name or old.resolve() == folder:
                continue
            runs = connection.execute("SELECT run_uuid FROM runs WHERE experiment_id = ?", (experiment,)).fetchall()
            moved = any((folder / run).is_dir() for (run,) in runs)
            if moved or (not old.parent.exists() and old.parent.name == folder.parent.name):
                log.warning("the MLflow store has moved: its artifacts are in %s, no longer in %s", folder, old)
                _replace_places(connection, place, folder.as_uri())


def _local_path(place: str) -> Path | None:
    """The folder that an artifact location names; None if it is on a server."""
    if place.startswith("file:"):
        return Path(url2pathname(urlsplit(place).path))
    return Path(place) if place and "://" not in place else None


def _replace_places(connection: sqlite3.Connection, old: str, new: str) -> None:
    """Replace the beginning of all places of artifacts in MLflow's tables."""
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    with connection:
        for table, column in LOCATIONS:
            if table in tables:
                connection.execute(
                    f"UPDATE {table} SET {column} = ? || substr({column}, ?) "  # noqa: S608  # names of LOCATIONS alone
                    f"WHERE {column} = ? OR substr({column}, 1, ?) = ?",
                    (new, len(old) + 1, old, len(old) + 1, f"{old}/"),
                )
