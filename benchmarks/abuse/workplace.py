"""A small room, tiny configs of several systems, and commands run in it: in this process, or in one that is killed."""

from __future__ import annotations

import contextlib
import io
import itertools
import logging
import os
import shutil
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import yaml
from mlflow import MlflowClient
from mlflow.entities import Run

from lightning_pose.__main__ import main
from lightning_pose.scenes.synthetic import render_room
from tests import processes
from tests.processes import ForkedProcess

__all__ = ["SYSTEMS", "Ended", "Workplace", "make_workplace", "run_command"]

SURF = {"class_path": "lightning_pose.features.SURF", "init_args": {"n_features": 50}}
KEYPOINTS = {"class_path": "lightning_pose.features.SURF", "init_args": {"n_features": 200, "with_geometry": True}}
CNN = {"class_path": "lightning_pose.features.CNN", "init_args": {"backbone": "efficientnet_lite0", "size": 64}}
IMAGES = {"batch_size": 8}
CLIPS = {"clip_length": 4, "stride": 2, "batch_size": 8}

SYSTEMS: Mapping[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "SurfLSTM": ("SurfLSTM", {"units": 16, "layers": 2, "dropout": 0.2}, {"extractor": SURF, **IMAGES}),
    "NodePose": ("NodePose", {"neighbours": 5, "dropout": 0.2}, {"extractor": CNN, **IMAGES}),
    "CNNRNN": ("CNNRNN", {"units": 16}, {"extractor": SURF, **CLIPS}),
    "LandmarkMap": ("LandmarkMap", {"bundle_adjust": "auto"}, {"extractor": KEYPOINTS, **IMAGES}),
    "refined": (
        "SurfLSTM",
        {"units": 16, "layers": 1, "refine": {"n_features": 200, "bundle_adjust": False}},
        {"extractor": SURF, **IMAGES},
    ),
}
"""By name: the class, its settings, and those of its data."""

SLOW_PACKAGES = ("alembic", "lightning_pose", "matplotlib", "mlflow", "scipy", "sklearn", "sqlalchemy", "torchmetrics")
"""Packages that commands import late, and processes to be killed have at once."""


_copies = itertools.count()


@dataclass(frozen=True)
class Ended:
    """How a command ended, and what it printed to standard error."""

    code: int
    stderr: str

    @property
    def is_clean(self) -> bool:
        """Whether it did its work, or said in one line why not."""
        return self.code in (0, 1) or (self.code == 2 and "Traceback" not in self.stderr and "error: " in self.stderr)


@dataclass(frozen=True)
class Workplace:
    """A folder that commands run in, with an MLflow store and a feature cache of its own.

    Attributes:
        folder: current folder of the commands.
        room: the scene.
        only: names of the cases that are asked for; all if there are none.
    """

    folder: Path
    room: Path
    only: tuple[str, ...] = ()

    def wants(self, case: str) -> bool:
        """Whether a case is asked for."""
        return not self.only or case in self.only

    @property
    def uri(self) -> str:
        return f"sqlite:///{self.folder / 'mlruns' / 'mlflow.db'}"

    @property
    def environment(self) -> dict[str, str]:
        return {"LIGHTNING_POSE_CACHE": str(self.folder / "cache"), "MLFLOW_TRACKING_URI": self.uri}

    def config(self, system: str, epochs: int = 5) -> Path:
        """The file of a system's config, which is written if it is missing."""
        name, model, data = SYSTEMS[system]
        kind = "ClipDataModule" if "clip_length" in data else "ImageDataModule"
        settings = {
            "seed_everything": 0,
            "trainer": {"max_epochs": epochs, "accelerator": "cpu", "devices": 1},
            "report": {"log_model": False},
            "model": {"class_path": f"lightning_pose.models.{name}", "init_args": model},
            "data": {"class_path": f"lightning_pose.data.{kind}", "init_args": {"root": str(self.room), **data}},
        }
        file = self.folder / f"{system}.yaml"
        file.write_text(yaml.safe_dump(settings))
        return file

    def run(self, *words: object) -> Ended:
        """A command in this process."""
        errors = io.StringIO()
        with (
            contextlib.chdir(self.folder),
            mock.patch.dict(os.environ, self.environment),
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(errors),
        ):
            code = main([str(word) for word in words])
        return Ended(code, errors.getvalue())

    def fork(self, *words: object) -> ForkedProcess:
        """A command in a process of its own, forked off one that has all modules that this process has by now."""
        late = [name for name in sys.modules if name.partition(".")[0] in SLOW_PACKAGES]
        processes.PRELOADED[:] = sorted({*processes.PRELOADED, *late})
        return ForkedProcess(
            run_command, [str(word) for word in words], folder=self.folder, environment=self.environment
        )

    def complete(self, *words: object) -> Ended:
        """A command in a process of its own, waited for."""
        with self.fork(*words) as process:
            _, errors = process.communicate(500)
            return Ended(process.wait(), errors)

    def runs(self) -> list[Run]:
        """Every MLflow run, the newest first."""
        client = MlflowClient(self.uri)
        experiment = client.get_experiment_by_name("lightning_pose")
        return list(client.search_runs([experiment.experiment_id])) if experiment else []

    def checkpoint(self, run: Run, name: str = "last") -> Path:
        return self.folder / "mlruns" / "checkpoints" / run.info.run_id / f"{name}.ckpt"

    def copy(self, features: bool = True) -> Workplace:
        """An empty workplace of the same room, in place of the last one, with or without this one's features."""
        for old in self.folder.glob("copy-*"):
            shutil.rmtree(old, ignore_errors=True)
        folder = self.folder / f"copy-{next(_copies)}"  # MLflow keeps a connection for each address
        (folder / "mlruns").mkdir(parents=True)
        if features and (self.folder / "cache").is_dir():
            shutil.copytree(self.folder / "cache", folder / "cache")
        shutil.copy(self.folder / "empty.db", folder / "mlruns" / "mlflow.db")
        shutil.copy(self.folder / "empty.db", folder / "empty.db")
        return Workplace(folder, self.room)


def run_command(words: list[str]) -> int:
    """A command as a shell starts it: no signal is ignored, as those of a background job may be."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    return main(words)


def make_workplace(folder: Path, only: Sequence[str] = ()) -> Workplace:
    """A workplace in this folder, which is emptied, and its room."""
    for noisy in ("alembic", "mlflow", "lightning_pose"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    folder = folder.absolute()
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "mlruns").mkdir(parents=True)
    MlflowClient(f"sqlite:///{folder / 'empty.db'}").search_experiments()  # making one takes seconds
    shutil.copy(folder / "empty.db", folder / "mlruns" / "mlflow.db")
    return Workplace(folder, render_room(folder / "room", frames=90, size=(320, 240)), tuple(only))
