"""Studies in PostgreSQL: several commands at once, one that is killed, and addresses that do not do."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator

import optuna
import pytest
import yaml
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.pool import NullPool

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
