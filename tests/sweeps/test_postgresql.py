"""Studies in PostgreSQL: several commands at once, one that is killed, outages, and addresses that do not do."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from typing import LiteralString

import optuna
import pytest
import yaml
from optuna.exceptions import StorageInternalError
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.pool import NullPool

from lightning_pose.models import SurfLSTM
from lightning_pose.sweeps import outages
from lightning_pose.sweeps import storage as studies
from lightning_pose.sweeps.storage import alone
from lightning_pose.sweeps.study import open_storage
from tests.helpers import Workplace
from tests.postgres import PASSWORD, serve

STUDY = "units-wall"


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """Start of the addresses of a PostgreSQL server."""
    with serve() as address:
        yield address


@pytest.fixture
def database(server: str) -> str:
    """Address of an empty database, as a user writes it."""
    import psycopg

    with psycopg.connect(f"{server}postgres", autocommit=True) as connection:
        connection.execute("DROP DATABASE IF EXISTS studies WITH (FORCE)")
        connection.execute("CREATE DATABASE studies")
    return f"{server}studies"


@pytest.fixture
def sweep(workplace: Workplace, database: str) -> list[str]:
    """A command that runs one trial more."""
    space = {"model.units": {"type": "int", "low": 4, "high": 40}}
    file = workplace.folder / "units.yaml"
    entries = {"base": "tiny.yaml", "settings": {"trainer.max_epochs": 2}, "pruner": "none", "space": space}
    file.write_text(yaml.safe_dump(entries))
    return ["sweep", str(file), "--storage", database, "--n_trials", "1"]


def trials(database: str) -> list[FrozenTrial]:
    address = database.replace("postgresql://", "postgresql+psycopg://")
    storage = RDBStorage(address, engine_kwargs={"poolclass": NullPool})  # the server has a hundred connections
    return optuna.load_study(study_name=STUDY, storage=storage).trials


def test_commands_share_a_study_and_another_goes_on(workplace: Workplace, sweep: list[str], database: str) -> None:
    commands = [workplace.start(*sweep[:-1], "2") for _ in range(2)]
    for command in commands:
        _, told = command.communicate(timeout=200)
        assert command.returncode == 0, told
        assert PASSWORD not in told
    assert workplace.command(*sweep) == 0
    assert [(t.number, t.state) for t in trials(database)] == [(n, TrialState.COMPLETE) for n in range(5)]
    assert len({trial.user_attrs["process"] for trial in trials(database)}) == 3
    assert len({trial.params["model.units"] for trial in trials(database)}) > 2, "the commands draw the same"
    numbers = [run.data.tags.get("sweep.trial", "study") for run in workplace.runs()]
    assert sorted(numbers) == [*"01234", "study"], "two commands that begin at once have one run"


def test_a_killed_command_s_trial_is_run_by_the_next(
    workplace: Workplace, sweep: list[str], database: str, capsys: pytest.CaptureFixture[str]
) -> None:
    killer = {"class_path": "tests.helpers.KillOnce", "init_args": {"marker": str(workplace.folder / "killed")}}
    sweep = [*sweep, "--trainer.callbacks", json.dumps([killer])]
    with workplace.start(*sweep) as command:
        _, told = command.communicate(timeout=200)
    assert command.returncode == -signal.SIGKILL, told
    assert [trial.state for trial in trials(database)] == [TrialState.RUNNING]
    assert workplace.command(*sweep) == 0
    assert "the process of trial 0 died; it is run again as trial 1" in capsys.readouterr().err
    dead, again = trials(database)
    assert (dead.state, again.state) == (TrialState.FAIL, TrialState.COMPLETE)
    assert again.params["model.units"] == dead.params["model.units"]
    (run,) = (run for run in workplace.runs() if run.info.run_id == dead.user_attrs["mlflow_run"])
    assert (run.info.status, run.data.tags["sweep.reason"]) == ("KILLED", "its process died")


class Restart:
    """A server that restarts: nobody is connected to the studies, nor can be, until someone pauses before trying again.

    It stands for the module `time` of those who pause.

    Attributes:
        pauses: how many there have been.
    """

    monotonic = staticmethod(time.monotonic)

    def __init__(self, server: str) -> None:
        self.server = server
        self.pauses = 0

    def begin(self) -> None:
        terminate = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = 'studies'"
        self._execute("ALTER DATABASE studies ALLOW_CONNECTIONS false", terminate)

    def sleep(self, seconds: float) -> None:
        self.pauses += 1
        self._execute("ALTER DATABASE studies ALLOW_CONNECTIONS true")

    def _execute(self, *statements: LiteralString) -> None:
        import psycopg

        with psycopg.connect(f"{self.server}postgres", autocommit=True) as connection:
            for statement in statements:
                connection.execute(statement)


@pytest.fixture
def restart(server: str, monkeypatch: pytest.MonkeyPatch) -> Restart:
    restart = Restart(server)
    monkeypatch.setattr(outages, "time", restart)
    return restart


def test_a_trial_outlives_a_restart_of_the_server(
    workplace: Workplace, sweep: list[str], database: str, restart: Restart, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the middle of an epoch: its heart beats in vain, the report waits for the server, and then the heart beats."""
    beats: list[str] = []
    beat = RDBStorage.record_heartbeat

    def count(self: RDBStorage, trial_id: int) -> None:
        try:
            beat(self, trial_id)
        except StorageInternalError:
            beats.append("vain")
            raise
        beats.append("heard")

    def await_beats(*awaited: str) -> None:
        deadline = time.monotonic() + 60
        while tuple(beats[-len(awaited) :]) != awaited:
            assert time.monotonic() < deadline, beats
            time.sleep(0.05)

    def train(self: SurfLSTM) -> None:
        await_beats("heard")
        if self.current_epoch == 0:
            restart.begin()
            await_beats("vain", "vain")

    monkeypatch.setattr(studies, "HEARTBEAT_SECONDS", 1)
    monkeypatch.setattr(RDBStorage, "record_heartbeat", count)
    monkeypatch.setattr(SurfLSTM, "on_train_epoch_start", train)
    assert workplace.command(*sweep) == 0
    assert [(trial.number, trial.state) for trial in trials(database)] == [(0, TrialState.COMPLETE)]
    assert restart.pauses >= 1


def test_who_is_alone_outlives_a_restart(
    workplace: Workplace, database: str, restart: Restart, capfd: pytest.CaptureFixture[str]
) -> None:
    storage = open_storage(database, workplace.uri)
    with alone(storage, STUDY):
        restart.begin()
    with alone(storage, STUDY):
        assert restart.pauses == 1
    assert capfd.readouterr().err == "the study's database is out of reach; it is tried again\n"


MISTAKES = {
    "password": (("ada:", "ada:never"), "password authentication failed for user"),
    "database": (("/studies", "/study"), 'database "study" does not exist'),
    "server": (("127.0.0.1:", "127.0.0.1:1/"), "failed: Connection refused"),
    "at sign": (("@", "@@"), "has a password with an @; write it as %40"),
}


@pytest.mark.parametrize(("change", "says"), MISTAKES.values(), ids=MISTAKES)
def test_a_wrong_address_is_one_line_without_the_password(
    change: tuple[str, str], says: str, workplace: Workplace, sweep: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert workplace.command(*(word.replace(*change) if "://" in word else word for word in sweep)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line
    assert "postgresql://ada:***@" in line
    assert "pass%" not in line
    assert "word" not in line.replace("password", "")
