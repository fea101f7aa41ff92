"""An epoch through `fit` against the same model and batches in a bare PyTorch loop, for all that is trained in steps.

    python -m benchmarks.epoch [--models all] [--epochs N] [--rounds 3] [--frames N]

Each architecture has the settings, the batch size and the shape of features of its file in `configs/`; features and
poses are random. Rounds of both alternate in one process. The bare loop shuffles, gathers batches by index, and steps
optimiser and schedule; `fit` does that, logs to MLflow, writes checkpoints and shows progress. The
goal is a ratio of at most 1.05, from the second epoch on. Standard error says what Lightning's loop takes alone, with
no logger, checkpoints or bar.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from statistics import median
from typing import Any, ClassVar

import numpy as np
import torch
import yaml
from lightning import Callback, Trainer
from torch.utils.data import DataLoader

from benchmarks.measurement import ROOT, Goal, Measurement, Options, Seconds, format_table
from lightning_pose import models
from lightning_pose.checkpoint import Spec
from lightning_pose.data import ClipDataModule, SceneDataModule
from lightning_pose.data.batches import PoseBatch, PoseDataset, make_loader
from lightning_pose.data.clip_dataset import ClipDataset, ClipShape
from lightning_pose.features import FeatureExtractor, Pixels
from lightning_pose.geometry.quaternions import align_hemisphere, quat_normalize
from lightning_pose.runs.checkpoints import BestCheckpoint, LastCheckpoint
from lightning_pose.runs.clock import TrainingClock
from lightning_pose.runs.epoch_bar import EpochBar
from lightning_pose.runs.logger import MLflowLogger
from lightning_pose.runs.recorder import RunRecorder
from lightning_pose.scenes.scene import Frame, Scene

FRAMES = {
    "surf_lstm": 640, "dense_posenet": 640, "node_pose": 640, "graph_pose": 640, "surf_cnn": 640, "cnn_rnn": 1280,
    "cnn_3d": 1280, "posenet": 64,
}  # fmt: skip
"""Configs of the architectures that are trained in steps, and frames of an epoch that takes seconds at most."""

EPOCHS = {"dense_posenet": 100, "node_pose": 20}
"""Short ones, of which several are written together; 3 of those that take about a second."""

LIMIT = 1.05


class RandomData(SceneDataModule):
    """Random features and poses, served as the real data module serves real ones."""

    def __init__(self, extractor: FeatureExtractor, frames: int, batch_size: int) -> None:
        SceneDataModule.__init__(self, extractor, batch_size, batch_size, cache_dir=None, workers=None)
        shape = frames, *extractor.feature_shape
        pixels = isinstance(extractor, Pixels)
        features = torch.randint(0, 256, shape, dtype=torch.uint8) if pixels else torch.randn(shape)
        position_m, quat_wxyz = torch.randn(frames, 3).double(), quat_normalize(torch.randn(frames, 4))
        self.train: PoseDataset = PoseDataset(PoseBatch(features, position_m, quat_wxyz, torch.arange(frames)))

    def _load_scene(self) -> Scene:
        poses = zip(self.train.data.position_m.numpy(), self.train.data.quat_wxyz.double().numpy(), strict=True)
        frames = tuple(Frame(Path(f"{i:06d}.png"), *pose, "random", i) for i, pose in enumerate(poses))
        none = np.zeros(0, np.int64)
        return Scene("random", Path(), "random", frames, {"train": np.arange(len(frames)), "val": none, "test": none})

    def prepare_data(self) -> None:
        """There is nothing to extract."""

    def dataset(self, split: str) -> PoseDataset:
        return self.train

    def train_dataloader(self) -> DataLoader[PoseBatch]:
        return make_loader(self.train, self.batch_size, shuffle=True)

    def val_dataloader(self) -> list[DataLoader[PoseBatch]]:
        return []

    def describe(self) -> Spec:
        return {"class_path": "benchmark", "init_args": {}}


class RandomClips(RandomData, ClipDataModule):
    """Clips of random frames."""

    gives_clips: ClassVar[bool] = True

    def __init__(self, extractor: FeatureExtractor, frames: int, batch_size: int, length: int, hop: int) -> None:
        super().__init__(extractor, frames, batch_size)
        self.relative_frame, self.clip_length, self.stride = "camera", length, 1
        self.train = ClipDataset(self.train.data, [np.arange(frames)], ClipShape(length, hop=hop))


class EpochClock(Callback):
    """Wall and CPU time from the start of the second epoch to the end of the last: the first warms up."""

    seconds = Seconds(0, 0)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: models.PoseModule) -> None:
        if trainer.current_epoch == 1:
            self.start = Seconds(time.perf_counter(), time.process_time())

    def on_train_end(self, trainer: Trainer, pl_module: models.PoseModule) -> None:
        self.seconds = Seconds(time.perf_counter() - self.start.wall, time.process_time() - self.start.cpu)


def make_object(spec: dict[str, Any], **further: object) -> Any:
    """An object of a config's class path and settings."""
    module, _, name = spec["class_path"].rpartition(".")
    return getattr(import_module(module), name)(**spec["init_args"], **further)


def make_case(name: str, frames: int | None) -> tuple[dict[str, Any], RandomData]:
    """The model's settings in a config, and random data for it."""
    config = yaml.safe_load((ROOT / "configs" / f"{name}.yaml").read_text())
    settings, frames = config["data"]["init_args"], frames or FRAMES[name]
    extractor = make_object(settings["extractor"])
    if "clip_length" in settings:
        clips = settings["clip_length"], settings["hop"]
        return config["model"], RandomClips(extractor, frames, settings["batch_size"], *clips)
    return config["model"], RandomData(extractor, frames, settings["batch_size"])


def fit_epochs(model: models.PoseModule, data: RandomData, epochs: int, alone: bool = False) -> Seconds:
    """Seconds of an epoch through `fit`, with everything that the command line adds to it; or of Lightning alone."""
    clock = EpochClock()
    with tempfile.TemporaryDirectory() as root:
        added = [RunRecorder(), TrainingClock(), LastCheckpoint(), EpochBar(), BestCheckpoint()]
        Trainer(
            max_epochs=epochs + 1,
            accelerator="cpu",
            logger=False if alone else MLflowLogger(root=root, tracking_uri=f"sqlite:///{root}/mlflow.db"),
            callbacks=[clock] if alone else [*added, clock],
            enable_checkpointing=not alone,
            enable_progress_bar=not alone,
            default_root_dir=root,
            enable_model_summary=False,
            log_every_n_steps=1,
        ).fit(model, datamodule=data)
    return Seconds(clock.seconds.wall / epochs, clock.seconds.cpu / epochs)


def run_bare(model: models.PoseModule, data: RandomData, epochs: int) -> Seconds:
    """Seconds of an epoch in a loop written by hand."""
    optimizer = torch.optim.AdamW(model.parameters(), lr=model.learning_rate, weight_decay=0.0, foreach=True)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1.0)
    model.train()
    wall, cpu = 0.0, 0.0
    for epoch in range(epochs + 1):
        if epoch == 1:
            wall, cpu = time.perf_counter(), time.process_time()
        for index in torch.randperm(len(data.train)).split(data.batch_size):
            batch = model.localize_batch(data.train.__getitems__(index.tolist()))
            position, quat_raw = model.decode_batch(batch)
            target = align_hemisphere(batch.quat_wxyz, model.quat_reference)
            loss = model.loss(position, quat_raw, batch.position_m.to(position.dtype), target)["total"]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return Seconds((time.perf_counter() - wall) / epochs, (time.process_time() - cpu) / epochs)


def measure_model(name: str, frames: int | None, epochs: int | None, rounds: int) -> Measurement:
    """Time both for the model of one config."""
    epochs = epochs or EPOCHS.get(name, 3)
    torch.manual_seed(0)
    spec, data = make_case(name, frames)
    ours, alone, theirs = [], [], []
    for _ in range(rounds):
        fitted, plain, bare = (make_object(spec, input_shape=list(data.extractor.feature_shape)) for _ in range(3))
        ours.append(fit_epochs(fitted, data, epochs))
        alone.append(fit_epochs(plain, data, epochs, alone=True))
        bare.load_state_dict(fitted.state_dict())  # with its scales, and what it keeps of training frames
        theirs.append(run_bare(bare, data, epochs))
    share = median(one.wall / other.wall for one, other in zip(alone, theirs, strict=True))
    print(f"{name}: Lightning alone takes {share:.2f} of the bare loop", file=sys.stderr, flush=True)
    items = f"{len(data.train)} {'clips' if data.gives_clips else 'frames'}, batches of {data.batch_size}"
    what = f"an epoch of `fit`, {type(fitted).__name__}, {items}"
    return Measurement.from_rounds(what, ours, "bare PyTorch loop", theirs, Goal("ratio", LIMIT))


def measure(
    options: Options, names: list[str] | None = None, epochs: int | None = None, frames: int | None = None
) -> Iterator[Measurement]:
    """A row for each architecture."""
    warnings.filterwarnings("ignore")
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    for name in names or FRAMES:
        yield measure_model(name, frames, epochs, options.rounds or 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", choices=[*FRAMES, "all"], default=["all"], help="names of configs")
    parser.add_argument("--frames", type=int, help="of an epoch (default: so many that it takes seconds at most)")
    parser.add_argument("--epochs", type=int, help="that are timed (default: 3, and more of short ones)")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    names = [*FRAMES] if "all" in args.models else args.models
    print(format_table([*measure(Options(rounds=args.rounds), names, args.epochs, args.frames)]))


if __name__ == "__main__":
    main()
