"""Independent tasks on threads and on a cluster: nothing is lost with a killed worker, and mistakes are one line."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import optuna
import pytest
import yaml

from lightning_pose.concurrency import tasks
from lightning_pose.concurrency.tasks import run_tasks
from lightning_pose.errors import ConfigError
from lightning_pose.features import FeatureCache
from lightning_pose.features.base import Record
from lightning_pose.features.fill_cluster import fill_on_cluster
from tests.cluster import Cluster, start_cluster
from tests.helpers import Thumbnails, Workplace


@pytest.fixture
def cluster(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    """Two worker processes on loopback, in the current folder of the test."""
    monkeypatch.chdir(workplace.folder)
    with start_cluster(workplace.folder, workplace.environment) as cluster:
        yield cluster


def square(number: int) -> int:
    return number * number


def fail(number: int) -> int:
    raise ValueError(f"task {number}")


@pytest.mark.parametrize("workers", [1, 3])
def test_threads_run_each_task_once(workers: int) -> None:
    assert sorted(run_tasks(square, range(20), workers)) == [(i, i * i) for i in range(20)]
    with pytest.raises(ValueError, match="task"):
        list(run_tasks(fail, range(4), workers))


class Fragile(Thumbnails):
    """Notes each call, and kills its process in the middle of the third."""

    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        Path(f"call-{len(images)}-{os.getpid()}-{time.monotonic_ns()}").touch()
        calls = len(list(Path.cwd().glob("call-*")))
        if calls == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.1)
        return super().extract(images)


def test_a_killed_worker_loses_no_image_and_repeats_only_what_it_had_under_way(
    cluster: Cluster, workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lightning_pose.features.fill_cluster.PER_TASK", 4)
    images = sorted(workplace.scene.rglob("*.png"))
    cache = FeatureCache(Fragile(), workplace.folder / "cache")
    report = fill_on_cluster(cache, images, cluster.address)
    assert sorted(worker.poll() is None for worker in cluster.workers) == [False, True]
    assert (report.total, report.computed + report.cached, report.redone) == (34, 34, 0)
    assert np.isfinite(cache.features(images, progress=False)).all()
    calls = [file.name.split("-") for file in workplace.folder.glob("call-*")]
    extracted = sum(int(images) for _, images, *_ in calls)
    assert 34 < extracted <= 34 + 2 * 4, "the killed batch, and perhaps one that had ended and was not reported"


def test_the_trial_of_a_killed_worker_is_run_again(
    long: None, cluster: Cluster, workplace: Workplace, capfd: pytest.CaptureFixture[str]
) -> None:
    killer = {"class_path": "tests.helpers.KillOnce", "init_args": {"marker": "killed", "epoch": 0}}
    settings = {"trainer.callbacks": [killer], "trainer.max_epochs": 1}
    sweep = {"base": "tiny.yaml", "sampler": "grid", "space": {"model.units": [4]}, "settings": settings}
    (workplace.folder / "units.yaml").write_text(yaml.safe_dump(sweep))
    assert workplace.command("sweep", "units.yaml", "--scheduler", cluster.address) == 0
    assert "trial 1/1" in capfd.readouterr().err
    study = optuna.load_study(study_name="units-wall", storage="sqlite:///mlruns/optuna.db")
    assert [(trial.state.name, trial.params) for trial in study.trials] == [
        ("FAIL", {"model.units": 4}),
        ("COMPLETE", {"model.units": 4}),
    ]
    assert study.trials[0].user_attrs["reason"] == "its process died"


def test_what_a_cluster_lacks_is_one_line(
    workplace: Workplace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks, "CONNECT_SECONDS", 0.3)
    with pytest.raises(
        ConfigError, match=r"tcp://127.0.0.1:9, which does not answer .* start one with `dask scheduler`"
    ):
        list(run_tasks(square, [1], scheduler="tcp://127.0.0.1:9"))
    with (
        start_cluster(tmp_path, {}, workers=0) as empty,
        pytest.raises(ConfigError, match=r"tcp.* has no workers; start"),
    ):
        list(run_tasks(square, [1], scheduler=empty.address))
    folders = f"runs in {tmp_path}, and this command in {Path.cwd()}; start both"
    with start_cluster(tmp_path, {}, workers=1) as elsewhere, pytest.raises(ConfigError, match=folders):
        list(run_tasks(square, [1], scheduler=elsewhere.address))
    monkeypatch.setattr(tasks, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="needs Dask's distributed; `uv sync --extra cluster`"):
        list(run_tasks(square, [1], scheduler="local"))
