"""The database of the studies: how it is reached, and how commands that share it keep out of each other's way."""

from __future__ import annotations

import re
import sqlite3
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import optuna
from optuna import Study
from optuna.exceptions import ExperimentalWarning, OptunaError
from optuna.trial import FrozenTrial
from sqlalchemy import create_engine, func, select
from sqlalchemy.engine import URL, Engine, make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from lightning_pose.errors import ConfigError
from lightning_pose.sweeps.outages import PatientStorage

__all__ = ["alone", "connect", "shown"]

HEARTBEAT_SECONDS, GRACE_SECONDS = 15, 60
PATIENCE_SECONDS = 30
DRIVERS = {"postgres": "postgresql", "postgresql": "postgresql+psycopg"}


def connect(url: str, silent: Callable[[Study, FrozenTrial], None]) -> PatientStorage:
    """Open Optuna's database, and make its tables where there are none.

    Args:
        url: SQLAlchemy's address, of SQLite or PostgreSQL.
        silent: called for a trial that Optuna has just failed because no heartbeat came for a minute.

    Raises:
        ConfigError: the database cannot be reached or read, or is of a kind that commands cannot share.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.filterwarnings("ignore", category=ExperimentalWarning)
    address = _address(url)
    if address.database and address.get_backend_name() == "sqlite":
        Path(address.database).parent.mkdir(parents=True, exist_ok=True)
    try:
        gate = create_engine(address, **_patience(address))
        try:
            with _locked(gate, 0):  # or two commands would make the same tables
                return _open(address, silent)
        finally:
            gate.dispose()
    except ImportError as error:
        missing = error.__cause__ or error
        raise ConfigError(
            f"--storage {shown(url)} needs a driver ({missing}); `uv sync --extra sweep` installs it"
        ) from error
    except (SQLAlchemyError, OptunaError, RuntimeError, OSError, sqlite3.Error) as error:
        told = str(getattr(error, "orig", None) or error).splitlines()[0]
        remedy = "check the address, and that the server runs and has the database"
        if address.get_backend_name() == "sqlite":
            remedy = "give an address such as sqlite:///DIR/optuna.db"
        raise ConfigError(f"--storage {shown(url)} cannot be used ({told}); {remedy}") from error


def _address(url: str) -> URL:
    """The address with its driver: psycopg for PostgreSQL, which SQLAlchemy before 2.1 does not take by itself."""
    remedy = "give sqlite:///DIR/optuna.db or postgresql://USER:PASSWORD@HOST/DATABASE"
    try:
        address = make_url(url)
    except (ArgumentError, ValueError) as error:
        raise ConfigError(f"--storage {shown(url)} is no database address; {remedy}") from error
    if "@" in (address.host or ""):
        raise ConfigError(f"--storage {shown(url)} has a password with an @; write it as %40")
    kind = address.get_backend_name()
    if kind not in ("sqlite", *DRIVERS):
        raise ConfigError(f"--storage {shown(url)} is of a kind that commands cannot share; {remedy}")
    if kind == "sqlite" and address.database in (None, "", ":memory:"):
        raise ConfigError(f"--storage {shown(url)} keeps nothing; {remedy}")
    if address.drivername in DRIVERS and (find_spec("psycopg") or not find_spec("psycopg2")):
        return address.set(drivername="postgresql+psycopg")
    return address.set(drivername="postgresql") if address.drivername in DRIVERS else address


def _open(address: URL, silent: Callable[[Study, FrozenTrial], None]) -> PatientStorage:
    return PatientStorage(
        address.render_as_string(hide_password=False),
        engine_kwargs=_patience(address),
        heartbeat_interval=HEARTBEAT_SECONDS,
        grace_period=GRACE_SECONDS,
        heartbeat_stale_trial_callback=silent,
    )


def _patience(address: URL) -> dict[str, Any]:
    """How long an engine waits: for other writers of a file, and for a server's answer."""
    if address.get_backend_name() == "sqlite":
        return {"connect_args": {"timeout": 2 * PATIENCE_SECONDS}}
    connect = {} if "connect_timeout" in address.query else {"connect_timeout": PATIENCE_SECONDS}
    # A server has 100 connections by default: each of many workers keeps but one while it has no need of more.
    return {"pool_pre_ping": True, "pool_size": 1, "max_overflow": 9, "connect_args": connect}


def shown(url: str) -> str:
    """A database's address without its password, even if it is malformed."""
    url = re.sub(r"(://[^:/@]*):.*@", r"\1:***@", url)
    return re.sub(r"([?&]password=)[^&]*", r"\1***", url)


@contextmanager
def alone(storage: PatientStorage, study: str) -> Iterator[None]:
    """Wait until no other process is in here for this study, and keep others out.

    Optuna has no such lock: of two processes that look at the queue of a SQLite file at once both may take the same
    trial, and two that fill it do so twice. The lock of a process that ends is released.

    Args:
        storage: of `connect`.
        study: name.
    """
    with ExitStack() as held:
        key = 1 + zlib.crc32(study.encode())
        storage.insist(lambda: held.enter_context(_locked(storage.engine, key)))
        yield


@contextmanager
def _locked(engine: Engine, key: int) -> Iterator[None]:
    if engine.dialect.name == "postgresql":
        with engine.connect() as connection:
            connection.execute(select(func.pg_advisory_xact_lock(key)))
            try:
                yield
            finally:
                with suppress(SQLAlchemyError):  # a server that is gone has given the lock back
                    connection.rollback()
        return
    # A database of its own, because a locked one could not be written to by the holder's other connections.
    with closing(sqlite3.connect(f"{engine.url.database}-lock", timeout=1, isolation_level=None)) as lock:
        while True:
            try:
                lock.execute("BEGIN EXCLUSIVE")
                break
            except sqlite3.OperationalError as error:
                if "locked" not in str(error):
                    raise
        yield
