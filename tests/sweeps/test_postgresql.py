"""Studies in PostgreSQL: several commands at once, one that is killed, outages, and wrong addresses."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from typing import LiteralString

import optuna
import pytest
import yaml
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import OperationalError
from sqlalchemy.pool import NullPool

from lightning_pose.models import SurfLSTM
from lightning_pose.sweeps import storage as studies
from lightning_pose.sweeps.storage import lock_study
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
    commands = [workplace.fork(*sweep[:-1], "2") for _ in range(2)]
    for command in commands:
        _, errors = command.communicate(timeout=200)
        assert command.returncode == 0, errors
        assert PASSWORD not in errors
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
    with workplace.fork(*sweep) as command:
        _, errors = command.communicate(timeout=200)
    assert command.returncode == -signal.SIGKILL, errors
    assert [trial.state for trial in trials(database)] == [TrialState.RUNNING]
    assert workplace.command(*sweep) == 0
    assert "the process of trial 0 died; it is run again as trial 1" in capsys.readouterr().err
    dead, again = trials(database)
    assert (dead.state, again.state) == (TrialState.FAIL, TrialState.COMPLETE)
    assert again.params["model.units"] == dead.params["model.units"]
    (run,) = (run for run in workplace.runs() if run.info.run_id == dead.user_attrs["mlflow_run"])
    assert (run.info.status, run.data.tags["sweep.reason"]) == ("KILLED", "its process died")


class Restart:
    """A server that restarts: it closes all connections to the studies and refuses others until the first pause.

    It replaces the module `time` where connections are tried again; time passes in pauses only.

    Attributes:
        pauses: how many there have been.
        waited: their seconds.
        lasts: whether the server stays out of reach.
    """

    def __init__(self, server: str) -> None:
        self.server = server
        self.pauses, self.waited, self.lasts = 0, 0.0, False

    def monotonic(self) -> float:
        return self.waited

    def begin(self) -> None:
        terminate = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = 'studies'"
        self._execute("ALTER DATABASE studies ALLOW_CONNECTIONS false", terminate)

    def sleep(self, seconds: float) -> None:
        self.pauses += 1
        self.waited += seconds
        if not self.lasts:
            self._execute("ALTER DATABASE studies ALLOW_CONNECTIONS true")

    def _execute(self, *statements: LiteralString) -> None:
        import psycopg

        with psycopg.connect(f"{self.server}postgres", autocommit=True) as connection:
            for statement in statements:
                connection.execute(statement)


@pytest.fixture
def restart(server: str, monkeypatch: pytest.MonkeyPatch) -> Restart:
    restart = Restart(server)
    monkeypatch.setattr(studies, "time", restart)
    return restart


def test_a_trial_goes_on_after_a_restart_of_the_server(
    workplace: Workplace, sweep: list[str], database: str, restart: Restart, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the middle of an epoch: a heartbeat or the report waits for the server, and heartbeats follow."""
    beats: list[int] = []
    record = RDBStorage.record_heartbeat

    def count(self: RDBStorage, trial_id: int) -> None:
        record(self, trial_id)
        beats.append(trial_id)

    def await_heartbeats(number: int) -> None:
        deadline = time.monotonic() + 60
        while len(beats) < number:
            assert time.monotonic() < deadline, beats
            time.sleep(0.05)

    def train(self: SurfLSTM) -> None:
        if self.current_epoch == 0:
            await_heartbeats(1)
            restart.begin()
            await_heartbeats(len(beats) + 2)

    monkeypatch.setattr(studies, "HEARTBEAT_SECONDS", 1)
    monkeypatch.setattr(RDBStorage, "record_heartbeat", count)
    monkeypatch.setattr(SurfLSTM, "on_train_epoch_start", train)
    assert workplace.command(*sweep) == 0
    assert [(trial.number, trial.state) for trial in trials(database)] == [(0, TrialState.COMPLETE)]
    assert restart.pauses >= 1


def test_the_lock_of_a_study_is_free_after_a_restart(
    workplace: Workplace, database: str, restart: Restart, capfd: pytest.CaptureFixture[str]
) -> None:
    storage = open_storage(database, workplace.uri)
    with lock_study(storage, STUDY):
        restart.begin()
    with lock_study(storage, STUDY):
        assert restart.pauses == 1
    assert capfd.readouterr().err == "the study's database is out of reach; it is tried again\n"


def test_an_outage_is_waited_for_two_minutes(workplace: Workplace, database: str, restart: Restart) -> None:
    storage = open_storage(database, workplace.uri)
    restart.lasts = True
    restart.begin()
    with pytest.raises(OperationalError), lock_study(storage, STUDY):
        pass
    assert 100 < restart.waited <= 120


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
