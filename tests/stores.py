"""MLflow stores with made-up runs, written as plain SQL: MLflow itself takes a tenth of a second for each."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

__all__ = ["FakeRun", "add_runs", "make_store", "many_runs"]

TAGS = {
    "verb": "fit",
    "dataset": "7scenes",
    "split": "official",
    "ground_truth": "original",
    "unit": "m",
    "features": "surf",
    "task": "absolute",
    "image_size": "640x480",
}
PARAMS = {"data.class_path": "lightning_pose.data.image_datamodule.ImageDataModule", "data.val_fraction": "0.1"}


@dataclass(frozen=True)
class FakeRun:
    """A run of one architecture on one scene.

    Attributes:
        system: architecture.
        scene: its name.
        test: median errors on the test frames, metres and degrees; None where it was not tested.
        val: median position error on validation frames; None where it has none.
        day: of March 2026, when it started.
        tags: beside those of `TAGS`; None takes one away.
        params: beside those of `PARAMS`, and the name, scene and features that `fit` keeps as parameters too.
        metrics: further ones.
        status: MLflow's.
        deleted: by the user.
        experiment: its name.
    """

    system: str = "SurfLSTM"
    scene: str = "chess"
    test: tuple[float, float] | None = (0.2, 8.0)
    val: float | None = 0.1
    day: int = 1
    tags: Mapping[str, str | None] = field(default_factory=dict)
    params: Mapping[str, str] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    status: str = "FINISHED"
    deleted: bool = False
    experiment: str = "lightning_pose"

    @property
    def all_metrics(self) -> dict[str, float]:
        errors = {} if self.test is None else dict(zip(("position_median_m", "orientation_median_deg"), self.test))  # noqa: B905
        own = {f"test/{name}": value for name, value in errors.items()}
        return {**own, **({} if self.val is None else {"val/position_median_m": self.val}), **self.metrics}

    @property
    def all_tags(self) -> dict[str, str]:
        tags = {**TAGS, "architecture": self.system, "scene": self.scene, **self.tags}
        return {name: value for name, value in tags.items() if value is not None}

    @property
    def all_params(self) -> dict[str, str]:
        tags = self.all_tags
        twice = {name: tags[name] for name in ("architecture", "scene", "features") if name in tags}
        return {**PARAMS, **twice, **self.params}


def make_store(file: Path, empty: Path, runs: Iterable[FakeRun], epochs: int = 0) -> str:
    """Copy an empty store and fill it; its tracking URI.

    Args:
        file: of the new store.
        empty: an empty store of MLflow's.
        runs: what it holds.
        epochs: how many values of each metric its history has.
    """
    shutil.copy(empty, file)
    add_runs(file, runs, epochs)
    return f"sqlite:///{file}"


def add_runs(file: Path, runs: Iterable[FakeRun], epochs: int = 0) -> None:
    """Append runs to a store."""
    with closing(sqlite3.connect(file)) as connection, connection:
        (first,) = connection.execute("SELECT COUNT(*) FROM runs").fetchone()
        for number, run in enumerate(runs, start=first):
            _add(connection, run, f"{number:032x}", epochs)


def _add(connection: sqlite3.Connection, run: FakeRun, run_id: str, epochs: int) -> None:
    known = connection.execute("SELECT experiment_id FROM experiments WHERE name = ?", [run.experiment]).fetchone()
    if known is None:
        (number,) = connection.execute("SELECT COUNT(*) + 1 FROM experiments").fetchone()
        connection.execute(
            "INSERT INTO experiments (experiment_id, name, lifecycle_stage) VALUES (?, ?, 'active')",
            [number, run.experiment],
        )
        known = (number,)
    started = int(datetime(2026, 3, run.day, 12).timestamp() * 1000)
    stage = "deleted" if run.deleted else "active"
    name = f"{run.system} {run.scene}"
    connection.execute(
        "INSERT INTO runs (run_uuid, name, status, start_time, lifecycle_stage, experiment_id, source_type,"
        " artifact_uri, user_id) VALUES (?, ?, ?, ?, ?, ?, 'LOCAL', '', 'ada')",
        [run_id, name, run.status, started, stage, *known],
    )
    for table, values in (("tags", run.all_tags), ("params", run.all_params)):
        rows = [(name, value, run_id) for name, value in values.items()]
        connection.executemany(f"INSERT INTO {table} (key, value, run_uuid) VALUES (?, ?, ?)", rows)
    rows = [_value(name, value) for name, value in run.all_metrics.items()]
    connection.executemany(
        "INSERT INTO latest_metrics (key, value, is_nan, timestamp, step, run_uuid) VALUES (?, ?, ?, 0, 0, ?)",
        [(*row, run_id) for row in rows],
    )
    connection.executemany(
        "INSERT INTO metrics (key, value, is_nan, timestamp, step, run_uuid) VALUES (?, ?, ?, 0, ?, ?)",
        [(*row, epoch, run_id) for row in rows for epoch in range(epochs)],
    )


def _value(name: str, value: float) -> tuple[str, float, int]:
    """As MLflow keeps it: infinity is the largest double, and what is no number is marked."""
    if value != value:
        return name, 0.0, 1
    return name, min(value, 1.7976931348623157e308), 0


def many_runs(count: int) -> list[FakeRun]:
    """Runs with some 60 settings and 60 metrics each, of eight systems on seven scenes."""
    scenes = ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")
    systems = [f"System{number}" for number in range(8)]
    settings = {f"model.setting_{i}": str(i) for i in range(58)}
    metrics = {f"{part}/metric_{i}": i / 7 for part in ("train", "val", "test", "baseline/oracle") for i in range(14)}
    return [
        FakeRun(
            system=systems[i % 8],
            scene=scenes[i // 8 % 7],
            test=(0.1 + i % 13 / 100, 3 + i % 11 / 10),
            val=0.1 + i % 17 / 100,
            day=1 + i % 28,
            params={**settings, "seed": str(i // 56)},
            metrics=metrics,
        )
        for i in range(count)
    ]
