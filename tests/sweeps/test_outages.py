"""A study's database that is out of reach for a while: trials wait for it, and hearts beat on."""

from __future__ import annotations

import optuna
import pytest
import sqlalchemy
from optuna.exceptions import StorageInternalError
from optuna.trial import TrialState
from sqlalchemy import event
from sqlalchemy.exc import DBAPIError, OperationalError, ProgrammingError

from lightning_pose.sweeps import outages
from lightning_pose.sweeps.outages import PatientStorage
from lightning_pose.sweeps.study import open_storage
from tests.helpers import Workplace


@pytest.fixture
def storage(workplace: Workplace) -> PatientStorage:
    return open_storage(f"sqlite:///{workplace.folder / 'mlruns' / 'optuna.db'}", workplace.uri)


@pytest.fixture
def study(storage: PatientStorage) -> optuna.Study:
    return optuna.create_study(storage=storage)


class Clock:
    """Time that passes only in pauses."""

    now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(outages, "time", clock)
    return clock


class Outage:
    """A database that fails until a time has come."""

    def __init__(self, storage: PatientStorage, clock: Clock) -> None:
        self.clock, self.end = clock, 0.0
        self.error: type[DBAPIError] = OperationalError
        event.listen(storage.engine, "before_cursor_execute", self.fail)

    def fail(self, *_: object) -> None:
        if self.clock.now < self.end:
            raise self.error("SELECT", {}, Exception("the server is gone"))

    def last(self, seconds: float) -> None:
        self.end = self.clock.now + seconds


@pytest.fixture
def outage(storage: PatientStorage, clock: Clock) -> Outage:
    return Outage(storage, clock)


def test_a_trial_outlives_an_outage(study: optuna.Study, outage: Outage) -> None:
    def objective(trial: optuna.Trial) -> float:
        outage.last(20)
        x = trial.suggest_float("x", 0, 1)
        outage.last(20)
        trial.report(x, 0)
        outage.last(20)
        trial.set_user_attr("name", "value")
        outage.last(20)
        return x

    study.optimize(objective, n_trials=1)
    (frozen,) = study.trials
    assert (frozen.state, frozen.user_attrs) == (TrialState.COMPLETE, {"name": "value"})
    assert frozen.intermediate_values == {0: frozen.value}


def test_an_outage_without_end_is_waited_for_once(study: optuna.Study, outage: Outage, clock: Clock) -> None:
    asked = study.ask()
    outage.last(1000)
    before = clock.now
    with pytest.raises(StorageInternalError):
        asked.set_user_attr("name", "value")
    assert 100 < clock.now - before <= 120
    before = clock.now
    with pytest.raises(StorageInternalError):
        asked.set_user_attr("name", "value")
    assert clock.now == before
    outage.last(0)
    asked.set_user_attr("name", "value")
    outage.last(20)
    asked.set_user_attr("name", "another")
    assert study.trials[0].user_attrs == {"name": "another"}


def test_what_the_database_refuses_is_not_tried_again(study: optuna.Study, outage: Outage, clock: Clock) -> None:
    asked = study.ask()
    outage.error = ProgrammingError
    outage.last(1000)
    before = clock.now
    with pytest.raises(StorageInternalError):
        asked.set_user_attr("name", "value")
    assert clock.now == before


def test_a_heart_beats_on_after_an_outage_and_stops_no_other(
    study: optuna.Study, storage: PatientStorage, outage: Outage, clock: Clock
) -> None:
    mine, other = (study.ask()._trial_id for _ in range(2))
    for trial_id in (mine, other):
        storage.record_heartbeat(trial_id)
    with storage.engine.begin() as connection:
        connection.execute(sqlalchemy.text("UPDATE trial_heartbeats SET heartbeat = datetime('now', '-5 minutes')"))
    outage.last(10)
    storage.record_heartbeat(mine)
    clock.sleep(15)
    storage.record_heartbeat(mine)
    assert storage._get_stale_trial_ids(study._study_id) == [], "the other's could not be heard either"
    clock.sleep(60)
    assert storage._get_stale_trial_ids(study._study_id) == [other]
