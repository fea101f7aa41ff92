"""An epoch through `fit` against the same model and batches in a bare PyTorch loop.

    python benchmarks/epoch.py [--model SurfLSTM] [--n_features 50] [--frames 650] [--epochs 10] [--rounds 3]

Rounds of both alternate in one process. The bare loop shuffles, gathers batches by index, and steps optimiser and
schedule; `fit` does that and logs to MLflow, checkpoints and shows progress. The goal is a ratio of at most 1.15.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import torch
from lightning import Callback, Trainer

from lightning_pose import models
from lightning_pose.checkpoint import Spec
from lightning_pose.data import SceneDataModule
from lightning_pose.data.batches import PoseBatch, PoseDataset, make_loader
from lightning_pose.features import SURF
from lightning_pose.geometry.quaternions import align_hemisphere, quat_normalize
from lightning_pose.runs.checkpoints import BestCheckpoint, LastCheckpoint
from lightning_pose.runs.clock import TrainingClock
from lightning_pose.runs.epoch_bar import EpochBar
from lightning_pose.runs.logger import MLflowLogger
from lightning_pose.runs.recorder import RunRecorder
from lightning_pose.scenes.scene import Scene


class RandomData(SceneDataModule):
    """Random descriptors and poses, served as the real data module serves real ones."""

    def __init__(self, frames: int, n_features: int, batch_size: int = 64) -> None:
        super().__init__(SURF(n_features), batch_size, batch_size, cache_dir=None, workers=None)
        self.train = PoseDataset(
            PoseBatch(
                torch.randn(frames, n_features, 64),
                torch.randn(frames, 3),
                quat_normalize(torch.randn(frames, 4)),
                torch.arange(frames),
            )
        )

    def _load_scene(self) -> Scene:
        return Scene("random", Path(), "random", ())

    def prepare_data(self) -> None:
        """There is nothing to extract."""

    def dataset(self, split: str) -> PoseDataset:
        return self.train

    def train_dataloader(self):
        return make_loader(self.train, self.batch_size, shuffle=True)

    def val_dataloader(self):
        return []

    def describe(self) -> Spec:
        return {"class_path": "benchmark", "init_args": {}}


class EpochClock(Callback):
    """Wall time from the start of the second epoch to the end of the last: the first warms up."""

    seconds = 0.0

    def on_train_epoch_start(self, trainer: Trainer, pl_module: models.PoseModule) -> None:
        if trainer.current_epoch == 1:
            self.start = time.perf_counter()

    def on_train_end(self, trainer: Trainer, pl_module: models.PoseModule) -> None:
        self.seconds = time.perf_counter() - self.start


def fitted(model: models.PoseModule, data: RandomData, epochs: int) -> float:
    """Seconds of an epoch through `fit`, with everything that the command line adds to it."""
    clock = EpochClock()
    with tempfile.TemporaryDirectory() as root:
        Trainer(
            max_epochs=epochs + 1,
            accelerator="cpu",
            logger=MLflowLogger(root=root, tracking_uri=f"sqlite:///{root}/mlflow.db"),
            callbacks=[RunRecorder(), TrainingClock(), LastCheckpoint(), EpochBar(), BestCheckpoint(), clock],
            default_root_dir=root,
            enable_model_summary=False,
            log_every_n_steps=1,
        ).fit(model, datamodule=data)
    return clock.seconds / epochs


def bare(model: models.PoseModule, data: RandomData, epochs: int) -> float:
    """Seconds of an epoch in a loop written by hand."""
    batch_size, train = data.batch_size, data.train.data
    optimizer = torch.optim.AdamW(model.parameters(), lr=model.learning_rate, weight_decay=0.0, foreach=True)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1.0)
    model.fit_scale(train.position_m, train.quat_wxyz)
    model.train()
    start = 0.0
    for epoch in range(epochs + 1):
        if epoch == 1:
            start = time.perf_counter()
        for index in torch.randperm(len(train.frame)).split(batch_size):
            batch = PoseBatch(*(tensor[index] for tensor in train))
            position_m, quat_raw = model.decode_features(batch.features)
            target = align_hemisphere(batch.quat_wxyz, model.quat_reference)
            loss = model.loss(position_m, quat_raw, batch.position_m, target)["total"]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return (time.perf_counter() - start) / epochs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="SurfLSTM")
    parser.add_argument("--n_features", type=int, default=50)
    parser.add_argument("--frames", type=int, default=650)
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    data = RandomData(args.frames, args.n_features)
    ratios = []
    for i in range(args.rounds):
        made = [getattr(models, args.model)(input_shape=list(data.extractor.feature_shape)) for _ in range(2)]
        ours, theirs = fitted(made[0], data, args.epochs), bare(made[1], data, args.epochs)
        ratios.append(ours / theirs)
        print(f"round {i + 1}: fit {ours:.3f} s an epoch, bare loop {theirs:.3f} s, ratio {ratios[-1]:.3f}")
    print(f"{args.model} N={args.n_features}: median ratio {statistics.median(ratios):.3f}")


if __name__ == "__main__":
    main()
