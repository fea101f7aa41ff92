"""Optuna's storage over short outages of its database, as while a server restarts."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

from optuna.exceptions import StorageInternalError
from optuna.storages import RDBStorage
from sqlalchemy.exc import DataError, IntegrityError, ProgrammingError, SQLAlchemyError

__all__ = ["PatientStorage"]

OUTAGE_SECONDS = 120.0
LONGEST_PAUSE_SECONDS = 8.0

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")


def _patient(method: F) -> F:
    @wraps(method)
    def insistent(self: PatientStorage, *args: Any, **kwargs: Any) -> Any:
        return self.insist(lambda: method(self, *args, **kwargs))

    return cast(F, insistent)


class PatientStorage(RDBStorage):
    """Retries each storage operation for two minutes; a failed heartbeat does not stop the heartbeat thread.

    Optuna itself gives up at once, which would end a training run of hours for a server's restart.
    """

    _lost = False
    _missed = -math.inf

    def insist(self, operation: Callable[[], T]) -> T:
        """Do something in the database, again and again while it is out of reach.

        Once that was in vain the next operation has one chance only, so that the end does not take two minutes each.

        Raises:
            SQLAlchemyError: the database is out of reach for good, or refuses what it is given.
            StorageInternalError: likewise, as Optuna says it.
        """
        pause, end = 0.5, time.monotonic() + (0 if self._lost else OUTAGE_SECONDS)
        told = False
        while True:
            try:
                found = operation()
            except (SQLAlchemyError, StorageInternalError) as error:
                if isinstance(error.__cause__ or error, DataError | IntegrityError | ProgrammingError):
                    raise  # it would be refused again
                self._lost = time.monotonic() + pause > end
                if self._lost:
                    raise
            else:
                self._lost = False
                return found
            if not told:
                print("the study's database is out of reach; it is tried again", file=sys.stderr, flush=True)
            told = True
            time.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE_SECONDS)

    def record_heartbeat(self, trial_id: int) -> None:
        """Give a sign of life; one that fails must not end the thread that gives them."""
        try:
            super().record_heartbeat(trial_id)
        except StorageInternalError:
            self._missed = time.monotonic()

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        """Trials without a recent heartbeat; none just after an outage, which heartbeats could not pass."""
        if time.monotonic() - self._missed < (self.grace_period or 0):
            return []
        return self.insist(lambda: super(PatientStorage, self)._get_stale_trial_ids(study_id))

    # Those through which Optuna's cache, studies and trials reach the database.
    _create_new_trial = _patient(RDBStorage._create_new_trial)
    _get_best_trial_id = _patient(RDBStorage._get_best_trial_id)
    _get_trials = _patient(RDBStorage._get_trials)
    _set_trial_param = _patient(RDBStorage._set_trial_param)
    get_study_directions = _patient(RDBStorage.get_study_directions)
    get_study_id_from_name = _patient(RDBStorage.get_study_id_from_name)
    get_study_system_attrs = _patient(RDBStorage.get_study_system_attrs)
    get_study_user_attrs = _patient(RDBStorage.get_study_user_attrs)
    get_trial = _patient(RDBStorage.get_trial)
    set_study_system_attr = _patient(RDBStorage.set_study_system_attr)
    set_study_user_attr = _patient(RDBStorage.set_study_user_attr)
    set_trial_intermediate_value = _patient(RDBStorage.set_trial_intermediate_value)
    set_trial_state_values = _patient(RDBStorage.set_trial_state_values)
    set_trial_system_attr = _patient(RDBStorage.set_trial_system_attr)
    set_trial_user_attr = _patient(RDBStorage.set_trial_user_attr)
