"""Failures in a sweep: Ctrl-C at any moment, processes that are killed or break, and stores that fail."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import optuna
import psutil
import pytest
import yaml
from lightning.pytorch.callbacks import Callback
from mlflow import MlflowClient
from mlflow.exceptions import MlflowException
from optuna.exceptions import StorageInternalError
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial, TrialState

from lightning_pose.runs.process import identify_machine, process_name
from lightning_pose.sweeps import trial, workers
from lightning_pose.sweeps.plan import Plan, read_plan
from lightning_pose.sweeps.study import open_storage, open_study, queue_again, recover_trials
from lightning_pose.sweeps.trial import EpochWatch, run_trial
from tests.helpers import Workplace
from tests.processes import start_fork_server

STUDY = "units-wall"
BOTH = ["val/position_median_m", "val/orientation_median_deg"]


def write(workplace: Workplace, **entries: Any) -> Path:
    """A sweep of the workplace's config."""
    file = workplace.folder / "units.yaml"
    space = {"model.units": {"type": "int", "low": 4, "high": 40}}
    file.write_text(yaml.safe_dump({"base": "tiny.yaml", "pruner": "none", "space": space} | entries))
    return file


def address(workplace: Workplace) -> str:
    return f"sqlite:///{workplace.folder / 'mlruns' / 'optuna.db'}"


@pytest.fixture
def storage(workplace: Workplace) -> RDBStorage:
    return open_storage(address(workplace), workplace.uri)


@pytest.fixture
def study(storage: RDBStorage) -> optuna.Study:
    return optuna.create_study(storage=storage)


def states(study: optuna.Study) -> list[str]:
    return [trial.state.name for trial in study.get_trials(deepcopy=False)]


class ExitOnce(Callback):
    """Ends one process, in the middle of an epoch, as an error outside the trial would; others end later.

    Args:
        marker: a file that exists once it has happened.
    """

    def __init__(self, marker: str) -> None:
        self.marker = Path(marker)

    def on_train_batch_end(self, *args: object, **kwargs: object) -> None:
        with contextlib.suppress(FileExistsError):
            self.marker.touch(exist_ok=False)
            os._exit(1)
        time.sleep(0.5)


def test_trials_under_way_are_finished_when_a_worker_breaks(
    workplace: Workplace, capsys: pytest.CaptureFixture[str]
) -> None:
    breaker = {
        "class_path": "tests.sweeps.test_failures.ExitOnce",
        "init_args": {"marker": str(workplace.folder / "x")},
    }
    settings = {"trainer.callbacks": [breaker], "trainer.max_epochs": 1}
    file = write(workplace, sampler="grid", space={"model.units": [4, 5, 6, 7]}, settings=settings)
    start_fork_server()
    with pytest.raises(RuntimeError, match="a worker of the sweep broke"):
        workplace.command("sweep", file, "--workers", "2")
    assert "the sweep breaks off; trials under way are finished first" in capsys.readouterr().err
    found = sorted(states(optuna.load_study(study_name=STUDY, storage=address(workplace))))
    assert found in (["COMPLETE", "RUNNING", "WAITING", "WAITING"], ["RUNNING", "WAITING", "WAITING", "WAITING"])


def dead_process() -> str:
    """The name of a process of this machine that has ended."""
    with subprocess.Popen(["true"]) as process:
        process.wait()
    return f"{identify_machine()}:{process.pid}"


def last(study: optuna.Study) -> FrozenTrial:
    return study.get_trials()[-1]


def test_a_trial_may_be_interrupted_more_often_than_its_process_is_killed(
    workplace: Workplace, study: optuna.Study, storage: RDBStorage
) -> None:
    study.enqueue_trial({"x": 0.5})
    for _ in range(5):
        number = study.ask().number
        study.tell(number, state=TrialState.FAIL)
        assert queue_again(study, study.trials[number], lost=False) == number + 1
    for again in (True, True, True, False):
        study.ask().set_user_attr("process", dead_process())
        dead = last(study).number
        assert recover_trials(study, storage, workplace.client) == (again, not again)
        assert study.trials[dead].state == TrialState.FAIL
    assert states(study) == ["FAIL"] * 9
    assert last(study).system_attrs["fixed_params"] == {"x": 0.5}


@pytest.mark.parametrize("host", [f"{socket.gethostname()} 01234567", socket.gethostname()])
def test_trials_of_another_machine_of_the_same_name_are_left_alone(
    host: str, workplace: Workplace, study: optuna.Study, storage: RDBStorage
) -> None:
    study.ask().set_user_attr("process", dead_process().replace(identify_machine(), host))
    study.ask().set_user_attr("process", process_name())
    assert recover_trials(study, storage, workplace.client) == (0, 0)
    assert states(study) == ["RUNNING"] * 2


@pytest.fixture
def job(workplace: Workplace, storage: RDBStorage, monkeypatch: pytest.MonkeyPatch) -> workers.Job:
    """A study with a run in MLflow."""
    monkeypatch.chdir(workplace.folder)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", workplace.uri)
    plan = read_plan(write(workplace, objective=BOTH), {})
    open_study(plan, STUDY, storage)
    experiment = workplace.client.create_experiment("lightning_pose")
    return workers.Job(plan, STUDY, address(workplace), workplace.client.create_run(experiment).info.run_id)


@pytest.fixture
def _ctrl_c() -> Iterator[None]:
    """Whoever runs the tests in the background has them ignore Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("_ctrl_c")
def test_a_second_ctrl_c_does_not_lose_the_trial_of_the_first(
    job: workers.Job, study: optuna.Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    def press(*args: Any, **kwargs: Any) -> None:
        signal.raise_signal(signal.SIGINT)

    def press_and_queue(*args: Any, **kwargs: Any) -> int | None:
        press()
        return queue_again(*args, **kwargs)

    monkeypatch.setattr(workers, "run_trial", press)
    monkeypatch.setattr(workers, "queue_again", press_and_queue)
    with pytest.raises(KeyboardInterrupt):
        workers.run_here(job, 2, lambda: None)
    assert states(job.open()[0]) == ["FAIL", "WAITING"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, AssertionError])
def test_a_failed_trial_does_not_hide_an_error_of_the_next(
    error: type[BaseException], job: workers.Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C, or a sampler's mistake, while Optuna chooses the next trial's values."""

    def fail(*args: object) -> NoReturn:
        raise error

    study, storage = job.open()
    monkeypatch.setattr(workers, "run_trial", lambda *args: 1 / 0)
    assert workers.run_next_trial(study, storage, job)
    monkeypatch.setattr(study.sampler, "before_trial", fail)
    with pytest.raises(error):
        workers.run_next_trial(study, storage, job)
    assert states(study) == ["FAIL", "RUNNING"]


def test_a_ctrl_c_in_a_trial_that_another_process_has_failed_ends_the_sweep(
    job: workers.Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, storage = job.open()

    def press(trial: optuna.Trial, *args: object) -> NoReturn:
        study.tell(trial.number, state=TrialState.FAIL)
        raise KeyboardInterrupt

    monkeypatch.setattr(workers, "run_trial", press)
    with pytest.raises(KeyboardInterrupt):
        workers.run_next_trial(study, storage, job)
    assert states(study) == ["FAIL"], "the process that failed it has queued it again"


def press_ctrl_c_once_two_wait(folder: Path) -> None:
    """Press Ctrl-C in this process alone, which passes it on to its workers."""
    deadline = time.monotonic() + 200
    while len(list(folder.glob("waits-*"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.usefixtures("_ctrl_c")
def test_ctrl_c_in_the_middle_of_two_workers_trials(workplace: Workplace, capsys: pytest.CaptureFixture[str]) -> None:
    """Each is queued again, and the next command runs it to its end."""
    waiter = {"class_path": "tests.helpers.WaitAt", "init_args": {"folder": str(workplace.folder)}}
    file = write(workplace, sampler="grid", space={"model.units": [4, 5]}, settings={"trainer.callbacks": [waiter]})
    start_fork_server()
    finger = threading.Thread(target=press_ctrl_c_once_two_wait, args=(workplace.folder,))
    finger.start()
    assert workplace.command("sweep", file, "--workers", "2") == 130
    finger.join()
    errors = capsys.readouterr().err
    assert "interrupted; the same command goes on" in errors
    assert "Traceback" not in errors
    study = optuna.load_study(study_name=STUDY, storage=address(workplace))
    assert states(study) == ["FAIL", "FAIL", "WAITING", "WAITING"]
    assert {trial.user_attrs["reason"] for trial in study.trials[:2]} == {"interrupted"}

    (workplace.folder / "go").touch()
    assert workplace.command("sweep", file) == 0
    assert "trial 2/2" in capsys.readouterr().err
    assert states(study) == ["FAIL", "FAIL", "COMPLETE", "COMPLETE"]
    assert sorted(trial.params["model.units"] for trial in study.trials[2:]) == [4, 5]
    runs = workplace.runs()
    assert sorted(run.info.status for run in runs) == ["FINISHED"] * 3 + ["KILLED"] * 2
    assert sorted(run.data.tags.get("sweep.state", "study") for run in runs) == [
        *["COMPLETE"] * 2, *["INTERRUPTED"] * 2, "study",
    ]  # fmt: skip


def test_workers_of_a_killed_command_finish_their_trials_and_end(workplace: Workplace) -> None:
    waiter = {"class_path": "tests.helpers.WaitAt", "init_args": {"folder": str(workplace.folder)}}
    file = write(
        workplace, sampler="grid", space={"model.units": [4, 5, 6, 7]}, settings={"trainer.callbacks": [waiter]}
    )
    with workplace.fork("sweep", file, "--workers", "2") as command:
        deadline = time.monotonic() + 200
        while len(list(workplace.folder.glob("waits-*"))) < 2:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        command.kill()
        processes = [psutil.Process(int(f.name.removeprefix("waits-"))) for f in workplace.folder.glob("waits-*")]
        (workplace.folder / "go").touch()
        assert psutil.wait_procs(processes, timeout=100)[1] == []
    study = optuna.load_study(study_name=STUDY, storage=address(workplace))
    assert sorted(states(study)) == ["COMPLETE", "COMPLETE", "WAITING", "WAITING"]


class Fitted:
    """Stands for training: it measures the given epochs."""

    curves: dict[str, dict[int, float]] = {}  # noqa: RUF012
    epochs: list[dict[str, float]] = [{"val/loss": 1.0} | dict.fromkeys(BOTH, 0.5)]  # noqa: RUF012

    def __init__(self, args: list[str], watch: EpochWatch, plan: Plan) -> None:
        watch.epochs = self.epochs
        self.measured: dict[str, float] = {}


def run_one(job: workers.Job) -> FrozenTrial:
    study, storage = job.open()
    assert workers.run_next_trial(study, storage, job)
    return last(study)


def test_a_task_of_a_cluster_runs_the_trial_of_a_dead_worker_again(
    job: workers.Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_in_turn(function: Any, tasks: list[Any], *_: object) -> Iterator[tuple[int, Any]]:
        """Stands for a cluster of one worker."""
        yield from ((number, function(task)) for number, task in enumerate(tasks))

    monkeypatch.setattr(trial, "TrialCLI", Fitted)
    monkeypatch.setattr(workers, "run_tasks", run_in_turn)
    shared, _ = job.open()
    shared.enqueue_trial({"model.units": 7})
    lost = shared.ask()
    lost.suggest_int("model.units", 4, 40)
    lost.set_user_attr("process", dead_process())
    ended: list[int] = []
    workers.run_on_cluster(job, 2, lambda: ended.append(1), 1, "tcp://127.0.0.1:8786")
    assert states(shared) == ["FAIL", "COMPLETE", "COMPLETE"]
    assert shared.trials[1].params == {"model.units": 7}
    assert len(ended) == 2


def test_a_study_whose_run_is_deleted_goes_on(
    job: workers.Job, workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial, "TrialCLI", Fitted)
    workplace.client.delete_run(job.parent)
    assert run_one(job).state == TrialState.COMPLETE


def test_a_value_that_is_no_number_has_a_reason(
    job: workers.Job, workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial, "TrialCLI", Fitted)
    monkeypatch.setattr(Fitted, "epochs", [{"val/loss": 1.0, BOTH[0]: 0.5, BOTH[1]: float("nan")}])
    ended = run_one(job)
    assert ended.state == TrialState.FAIL
    assert ended.user_attrs["reason"].startswith("val/orientation_median_deg came out as nan; lower the learning rate")
    run = workplace.client.get_run(ended.user_attrs["mlflow_run"])
    assert (run.info.status, run.data.tags["sweep.state"]) == ("FAILED", "FAILED")


def test_a_trial_without_a_run_has_a_reason(job: workers.Job, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: Any, **kwargs: Any) -> NoReturn:
        raise MlflowException("the server is full")

    monkeypatch.setattr(MlflowClient, "create_run", fail)
    ended = run_one(job)
    assert (ended.state, ended.user_attrs["reason"]) == (TrialState.FAIL, "MlflowException: the server is full")


@pytest.mark.parametrize("gone", ["mlflow", "optuna"])
def test_a_ctrl_c_ends_the_sweep_although_a_store_fails(
    gone: str, job: workers.Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: Any, **kwargs: Any) -> NoReturn:
        raise MlflowException("out of reach") if gone == "mlflow" else StorageInternalError

    def press(*args: Any) -> NoReturn:
        monkeypatch.setattr(*((MlflowClient, "set_tag") if gone == "mlflow" else (optuna.Trial, "set_user_attr")), fail)
        raise KeyboardInterrupt

    monkeypatch.setattr(trial, "TrialCLI", press)
    study, _ = job.open()
    with pytest.raises(KeyboardInterrupt):
        run_trial(study.ask(), job.plan, job.parent)


def test_a_trial_that_breaks_leaves_no_checkpoint(workplace: Workplace) -> None:
    breaker = {"class_path": "tests.helpers.FailAt", "init_args": {"epoch": 1}}
    settings = {"trainer.callbacks": [breaker]}
    file = write(workplace, measure="test", sampler="grid", space={"model.units": [4]}, settings=settings)
    assert workplace.command("sweep", file) == 2
    (ended,) = optuna.load_study(study_name=STUDY, storage=address(workplace)).trials
    assert ended.user_attrs["reason"] == "RuntimeError: a mistake in the program"
    assert list((workplace.folder / "mlruns" / "checkpoints").rglob("*")) == []
