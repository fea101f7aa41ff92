"""The database of the studies: connections to it, and a lock for commands that share a study."""

from __future__ import annotations

import re
import sqlite3
import sys
import time
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

import optuna
from optuna import Study
from optuna.exceptions import ExperimentalWarning, OptunaError
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial
from sqlalchemy import create_engine, event, func, select
from sqlalchemy.engine import URL, Dialect, Engine, make_url
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from lightning_pose.errors import ConfigError

__all__ = ["connect_storage", "hide_password", "lock_study"]

HEARTBEAT_SECONDS, GRACE_SECONDS = 15, 60
PATIENCE_SECONDS = 30
OUTAGE_SECONDS, LONGEST_PAUSE_SECONDS = 120.0, 8.0
DRIVERS = {"postgres": "postgresql", "postgresql": "postgresql+psycopg"}


def connect_storage(url: str, on_stale: Callable[[Study, FrozenTrial], None]) -> RDBStorage:
    """Open Optuna's database, and create its tables where there are none.

    Once it is open, a server that restarts is waited for, up to two minutes.

    Args:
        url: SQLAlchemy's address, of SQLite or PostgreSQL.
        on_stale: called for each trial that Optuna has failed because it had no heartbeat for a minute.

    Raises:
        ConfigError: the database cannot be reached or read, or is of a kind that commands cannot share.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.filterwarnings("ignore", category=ExperimentalWarning)
    address = _parse_address(url)
    if address.database and address.get_backend_name() == "sqlite":
        Path(address.database).parent.mkdir(parents=True, exist_ok=True)
    try:
        engine = create_engine(address, **_engine_options(address))
        try:
            with _lock_database(engine, 0):  # or two commands would create the same tables
                storage = RDBStorage(
                    address.render_as_string(hide_password=False),
                    engine_kwargs=_engine_options(address),
                    heartbeat_interval=HEARTBEAT_SECONDS,
                    grace_period=GRACE_SECONDS,
                    heartbeat_stale_trial_callback=on_stale,
                )
        finally:
            engine.dispose()
    except ImportError as error:
        missing = error.__cause__ or error
        raise ConfigError(
            f"--storage {hide_password(url)} needs a driver ({missing}); `uv sync --extra sweep` installs it"
        ) from error
    except (SQLAlchemyError, OptunaError, RuntimeError, OSError, sqlite3.Error) as error:
        reason = str(getattr(error, "orig", None) or error).splitlines()[0]
        remedy = "check the address, and that the server runs and has the database"
        if address.get_backend_name() == "sqlite":
            remedy = "give an address such as sqlite:///DIR/optuna.db"
        raise ConfigError(f"--storage {hide_password(url)} cannot be used ({reason}); {remedy}") from error
    event.listen(storage.engine, "do_connect", _connect_patiently)
    return storage


def _parse_address(url: str) -> URL:
    """The address with its driver: psycopg for PostgreSQL, which is not the default of SQLAlchemy before 2.1."""
    remedy = "give sqlite:///DIR/optuna.db or postgresql://USER:PASSWORD@HOST/DATABASE"
    shown = f"--storage {hide_password(url)}"
    try:
        address = make_url(url)
    except (ArgumentError, ValueError) as error:
        raise ConfigError(f"{shown} is no database address; {remedy}") from error
    if "@" in (address.host or ""):
        raise ConfigError(f"{shown} has a password with an @; write it as %40")
    kind = address.get_backend_name()
    if kind not in ("sqlite", *DRIVERS):
        raise ConfigError(f"{shown} is of a kind that commands cannot share; {remedy}")
    if kind == "sqlite" and address.database in (None, "", ":memory:"):
        raise ConfigError(f"{shown} keeps nothing; {remedy}")
    if address.drivername in DRIVERS:
        psycopg = find_spec("psycopg") or not find_spec("psycopg2")
        return address.set(drivername="postgresql+psycopg" if psycopg else "postgresql")
    return address


def _engine_options(address: URL) -> dict[str, object]:
    """SQLAlchemy's options: how long to wait for other writers of a file, or for a server's answer.

    A server's connections are tested before use, and replaced where the server has closed them.
    """
    if address.get_backend_name() == "sqlite":
        return {"connect_args": {"timeout": 2 * PATIENCE_SECONDS}}
    connect = {} if "connect_timeout" in address.query else {"connect_timeout": PATIENCE_SECONDS}
    # A server has 100 connections by default: each of many workers keeps one, and opens more where it needs them.
    return {"pool_pre_ping": True, "pool_size": 1, "max_overflow": 9, "connect_args": connect}


def _connect_patiently(
    dialect: Dialect, record: object, args: Sequence[object], kwargs: Mapping[str, object]
) -> DBAPIConnection:
    """Make one connection, repeatedly for two minutes while the server is out of reach.

    Optuna itself gives up at once, which would end a training run of hours because a server restarts.
    """
    pause, end, reported = 0.5, time.monotonic() + OUTAGE_SECONDS, False
    while True:
        try:
            return dialect.connect(*args, **kwargs)
        except dialect.loaded_dbapi.OperationalError:
            if time.monotonic() + pause > end:
                raise
        if not reported:
            print("the study's database is out of reach; it is tried again", file=sys.stderr, flush=True)
        reported = True
        time.sleep(pause)
        pause = min(2 * pause, LONGEST_PAUSE_SECONDS)


def hide_password(url: str) -> str:
    """A database's address without its password, even if it is malformed."""
    url = re.sub(r"(://[^:/@]*):.*@", r"\1:***@", url)
    return re.sub(r"([?&]password=)[^&]*", r"\1***", url)


@contextmanager
def lock_study(storage: RDBStorage, study: str) -> Iterator[None]:
    """Hold a study's lock: one process at a time is in this context; it is released when its process ends.

    Optuna has no such lock: of two processes that read the queue of a SQLite file at once both may take the same
    trial, and two that fill it do so twice.

    Args:
        storage: of `connect_storage`.
        study: name.
    """
    with _lock_database(storage.engine, 1 + zlib.crc32(study.encode())):
        yield


@contextmanager
def _lock_database(engine: Engine, key: int) -> Iterator[None]:
    if engine.dialect.name == "postgresql":
        with engine.connect() as connection:
            connection.execute(select(func.pg_advisory_xact_lock(key)))
            try:
                yield
            finally:
                with suppress(SQLAlchemyError):  # a server that is gone has released the lock
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
