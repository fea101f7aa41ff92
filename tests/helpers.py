"""A scene, an extractor and a command line so small that a training run takes a second."""

from __future__ import annotations

import contextlib
import io
import math
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import yaml
from lightning import Trainer
from lightning.pytorch.callbacks import Callback
from mlflow import MlflowClient
from mlflow.entities import Run

from lightning_pose.__main__ import main
from lightning_pose.features.base import FeatureExtractor, Record
from tests.processes import ForkedProcess

__all__ = [
    "REPOSITORY",
    "FailAt",
    "InterruptAt",
    "KillOnce",
    "TerminateAt",
    "Thumbnails",
    "Trained",
    "WaitAt",
    "Workplace",
    "limit_file_size",
    "write_scene",
]

REPOSITORY = Path(__file__).parents[1]


class Thumbnails(FeatureExtractor):
    """The image, shrunk to a few gray pixels, as (rows, columns) features.

    Args:
        rows: of the thumbnail.
        columns: of the thumbnail.
    """

    color = "gray"
    primary = "thumbnail"

    def __init__(self, rows: int = 6, columns: int = 8) -> None:
        self.rows, self.columns = rows, columns

    @property
    def settings(self) -> Mapping[str, str | int | float | bool | None]:
        return {"rows": self.rows, "columns": self.columns}

    @property
    def feature_shape(self) -> tuple[int, ...]:
        return self.rows, self.columns

    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        size = self.columns, self.rows
        shrunk = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
        return [{"thumbnail": thumbnail.astype(np.float32) / 127.5 - 1} for thumbnail in shrunk]


class FailAt(Callback):
    """Breaks in the middle of an epoch, as a mistake in a program would."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def on_train_batch_end(self, trainer: Trainer, *args: object, **kwargs: object) -> None:
        if trainer.current_epoch == self.epoch:
            self.stop()

    def stop(self) -> None:
        raise RuntimeError("a mistake in the program")


class InterruptAt(FailAt):
    """Presses Ctrl-C in the middle of an epoch."""

    def stop(self) -> None:
        raise KeyboardInterrupt


class TerminateAt(FailAt):
    """Asks the process to end in the middle of an epoch."""

    def stop(self) -> None:
        signal.raise_signal(signal.SIGTERM)


class KillOnce(FailAt):
    """Kills its process in the middle of an epoch, as `kill -9` does; the next process that comes there lives.

    Args:
        marker: a file that says that it has happened.
        epoch: in which it happens.
    """

    def __init__(self, marker: str, epoch: int = 1) -> None:
        super().__init__(epoch)
        self.marker = Path(marker)

    def stop(self) -> None:
        with contextlib.suppress(FileExistsError):
            self.marker.touch(exist_ok=False)
            os.kill(os.getpid(), signal.SIGKILL)


class WaitAt(FailAt):
    """Leaves a file for its process in the middle of an epoch, and goes on only when the file `go` is there as well.

    Args:
        folder: of these files.
        epoch: in which it happens.
    """

    def __init__(self, folder: str, epoch: int = 1) -> None:
        super().__init__(epoch)
        self.folder = Path(folder)

    def stop(self) -> None:
        (self.folder / f"waits-{os.getpid()}").touch()
        deadline = time.monotonic() + 300
        while not (self.folder / "go").exists():
            assert time.monotonic() < deadline
            time.sleep(0.05)


@contextlib.contextmanager
def limit_file_size(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond `size` bytes, as a disk does that is nearly full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def write_scene(root: Path, train: Sequence[int] = (12, 12), test: int = 10, size: tuple[int, int] = (64, 48)) -> Path:
    """A scene in 7-Scenes layout: windows of one smooth wallpaper, whose places are the positions.

    Args:
        root: folder to write.
        train: number of frames in each training sequence.
        test: number of frames in the one test sequence.
        size: width and height of the images.
    """
    rng = np.random.default_rng(0)
    wallpaper = cv2.resize(rng.uniform(0, 255, (24, 32)), None, fx=10, fy=10, interpolation=cv2.INTER_CUBIC)
    wallpaper = np.clip(wallpaper + rng.normal(0, 3, wallpaper.shape), 0, 255).astype(np.uint8)
    root.mkdir(parents=True)
    lengths = [*train, test]
    for file, numbers in (("TrainSplit.txt", range(len(train))), ("TestSplit.txt", [len(train)])):
        (root / file).write_text("".join(f"sequence{number + 1}\n" for number in numbers))
    for number, length in enumerate(lengths):
        folder = root / f"seq-{number + 1:02d}"
        folder.mkdir()
        for i in range(length):
            along = i / max(length - 1, 1)
            x = int(along * (wallpaper.shape[1] - size[0]))
            y = int((number + 0.5) / len(lengths) * (wallpaper.shape[0] - size[1]))
            stem = folder / f"frame-{i:06d}"
            cv2.imwrite(f"{stem}.color.png", wallpaper[y : y + size[1], x : x + size[0]])
            np.savetxt(f"{stem}.pose.txt", _pose(x / 100, y / 100, turn=along), fmt="%.9f")
    return root


def _pose(x: float, y: float, turn: float) -> np.ndarray:
    """(4, 4) camera-to-world, turned by `turn` radians about the vertical axis."""
    cos, sin = math.cos(turn), math.sin(turn)
    return np.array([[cos, 0, sin, x], [0, 1, 0, y], [-sin, 0, cos, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Workplace:
    """A folder to run the command line in: a scene, a config, and an MLflow store.

    Attributes:
        folder: the current folder of its runs.
        scene: a scene of `write_scene`.
        config: trains a tiny SurfLSTM on it for two epochs.
    """

    folder: Path
    scene: Path
    config: Path

    @classmethod
    def make(cls, folder: Path, scene: Path, store: Path) -> Workplace:
        """Set up a folder, with a copy of an empty MLflow store, because making one takes seconds."""
        (folder / "mlruns").mkdir(parents=True)
        shutil.copy(store, folder / "mlruns" / "mlflow.db")
        config = {
            "trainer": {"max_epochs": 2, "accelerator": "cpu", "devices": 1},
            "report": {"log_model": False},  # half of the time of so short a run
            "model": {
                "class_path": "lightning_pose.models.SurfLSTM",
                "init_args": {"units": 8, "layers": 1, "learning_rate": 0.01, "schedule": "constant"},
            },
            "data": {
                "class_path": "lightning_pose.data.ImageDataModule",
                "init_args": {
                    "extractor": {"class_path": "tests.helpers.Thumbnails"},
                    "root": str(scene),
                    "batch_size": 8,
                },
            },
        }
        (folder / "tiny.yaml").write_text(yaml.safe_dump(config))
        return cls(folder, scene, folder / "tiny.yaml")

    @property
    def client(self) -> MlflowClient:
        # An absolute path: MLflow keeps a connection for each address, and tests change the current folder.
        return MlflowClient(self.uri)

    @property
    def uri(self) -> str:
        return f"sqlite:///{self.folder / 'mlruns' / 'mlflow.db'}"

    @property
    def environment(self) -> dict[str, str]:
        """What a process needs that runs here."""
        return {"MLFLOW_TRACKING_URI": self.uri, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}

    def run(self, verb: str, *args: object) -> int:
        """One command, with this workplace's config; the exit code."""
        return self.command(verb, "--config", self.config, *args)

    def command(self, *args: object, allow: Sequence[str] = ("tests.helpers.Thumbnails",)) -> int:
        """One command; the exit code. Verbs that read a checkpoint may import the classes in `allow`."""
        if args[0] in ("test", "validate", "predict"):
            args = (*args, *(word for name in allow for word in ("--allow", name)))
        with contextlib.chdir(self.folder), mock.patch.dict(os.environ, self.environment):
            return main([str(arg) for arg in args])

    def fork(self, *args: object) -> ForkedProcess:
        """One command in a process of its own, which need not import anything."""
        words = [str(arg) for arg in args]
        return ForkedProcess(main, words, folder=self.folder, environment=self.environment)

    def start(self, *args: object) -> subprocess.Popen[str]:
        """One command through the real entry point, in a fresh Python."""
        return subprocess.Popen(
            [sys.executable, "-m", "lightning_pose", *map(str, args)],
            cwd=self.folder,
            env={**os.environ, **self.environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # Whoever runs the tests in the background has them ignore Ctrl-C, and so their children.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )

    def runs(self) -> list[Run]:
        """Every run, the newest first."""
        experiment = self.client.get_experiment_by_name("lightning_pose")
        return list(self.client.search_runs([experiment.experiment_id])) if experiment else []

    def checkpoint(self, run: Run, name: str) -> Path:
        return self.folder / "mlruns" / "checkpoints" / run.info.run_id / f"{name}.ckpt"


@dataclass(frozen=True)
class Trained:
    """A finished run of `fit`.

    Attributes:
        workplace: where it ran.
        run: what MLflow knows of it.
        stdout: what it printed.
    """

    workplace: Workplace
    run: Run
    stdout: str

    @classmethod
    def make(cls, workplace: Workplace, *args: object) -> Trained:
        """Run `fit` with the workplace's config."""
        with contextlib.redirect_stdout(io.StringIO()) as stdout:
            assert workplace.run("fit", "--report.log_model", "true", *args) == 0
        return cls(workplace, workplace.runs()[0], stdout.getvalue())

    @property
    def best(self) -> Path:
        return self.workplace.checkpoint(self.run, "best")

    @property
    def last(self) -> Path:
        return self.workplace.checkpoint(self.run, "last")
