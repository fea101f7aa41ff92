"""What the benchmarks of the landmark map share: scenes, maps fitted in this process, their errors, and tables."""

from __future__ import annotations

import argparse
import logging
import re
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from lightning import Trainer, seed_everything

from lightning_pose.data import ImageDataModule
from lightning_pose.data.batches import PoseBatch
from lightning_pose.features import SURF, FeatureExtractor
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m
from lightning_pose.mapping.map_localizer import MapAnswer
from lightning_pose.models import LandmarkMap, Pose, PoseModule
from lightning_pose.models.parts.answers import convert_answers
from lightning_pose.models.parts.frame_cameras import list_cameras

__all__ = [
    "Errors",
    "FittedMap",
    "add_scene_arguments",
    "find_truths",
    "fit_map",
    "load_scene",
    "measure_poses",
    "print_table",
    "train",
]


@dataclass(frozen=True)
class Errors:
    """Errors of N poses in metres and degrees (N,), and which of them the map accepted (N,)."""

    position_m: np.ndarray
    orientation_deg: np.ndarray
    accepted: np.ndarray

    def select(self, kept: np.ndarray) -> Errors:
        """Those under a mask."""
        return Errors(self.position_m[kept], self.orientation_deg[kept], self.accepted[kept])

    @property
    def medians(self) -> str:
        return f"{np.median(self.position_m):.4f} / {np.median(self.orientation_deg):.3f}"

    @property
    def within_5cm(self) -> str:
        return f"{np.mean((self.position_m <= 0.05) & (self.orientation_deg <= 5)):.0%}"


def measure_poses(pose: Pose, truth: PoseBatch, answers: Sequence[MapAnswer]) -> Errors:
    """Errors of N poses in the world, which may come from the map's answers."""
    return Errors(
        position_error_m(pose.position_m.double(), truth.position_m.double()).numpy(),
        orientation_error_deg(pose.quat_wxyz.double(), truth.quat_wxyz.double()).numpy(),
        np.array([answer.accepted for answer in answers]),
    )


@dataclass(frozen=True)
class FittedMap:
    """A landmark map, the data that it was fitted on, and the CPU seconds that took."""

    module: LandmarkMap
    data: ImageDataModule
    cpu_s: float

    def locate(self, split: str = "test") -> list[MapAnswer]:
        """What the map says of the frames of a split."""
        frames = self.data.dataset(split).data
        with torch.inference_mode():
            return self.module.network.locate(
                frames.features, list_cameras(self.data, frames.frame.tolist(), self.module.network.view)
            )

    def measure(self, answers: Sequence[MapAnswer], split: str = "test") -> Errors:
        """Errors of answers for the frames of a split."""
        return measure_poses(convert_answers(answers, self.module.world_frame), self.data.dataset(split).data, answers)

    @property
    def adjusted(self) -> bool:
        """Whether bundle adjustment has moved the training poses."""
        point_map = self.module.network.point_map
        return not np.array_equal(point_map.position, point_map.given_position)


def load_scene(
    root: str, truth: str = "original", pgt: str | None = None, extractor: FeatureExtractor | None = None,
    split: str | None = None, camera: str | None = None,
) -> ImageDataModule:  # fmt: skip
    """A scene with the keypoints of `extractor`: 300 U-SURF by default."""
    return ImageDataModule(
        extractor or SURF(300, with_geometry=True), root=root, ground_truth=truth,  # type: ignore[arg-type]
        pgt=pgt if truth == "sfm" else None, batch_size=256, split=split, camera=camera, workers=1,
    )  # fmt: skip


def train(module: PoseModule, data: ImageDataModule) -> float:
    """One epoch on the CPU, with neither logger nor files. Returns CPU seconds; features are read before."""
    data.fill()
    for split in ("train", "val"):
        data.dataset(split)
    seed_everything(0)
    start = time.process_time()
    make_trainer().fit(module, datamodule=data)
    module.eval()
    return time.process_time() - start


def fit_map(data: ImageDataModule, bundle_adjust: bool | str = "auto", refit: bool = True) -> FittedMap:
    """As `fit --config configs/landmark_map.yaml` does."""
    module = LandmarkMap(input_shape=list(data.input_shape), bundle_adjust=bundle_adjust, refit=refit)  # type: ignore[arg-type]
    return FittedMap(module, data, train(module, data))


def list_reasons(answers: Sequence[MapAnswer]) -> str:
    """Why answers are refused, with counts."""
    reasons = Counter(re.split(r"[:\d]", answer.reason)[0].strip() for answer in answers if not answer.accepted)
    return ", ".join(f"{count} {reason}" for reason, count in reasons.most_common()) or "-"


def make_trainer() -> Trainer:
    return Trainer(
        max_epochs=1, accelerator="cpu", devices=1, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0,
    )  # fmt: skip


def add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--root", required=True, help="the scene's folder")
    parser.add_argument("--pgt", help="folder of the pseudo ground truth: everything also under SfM poses")
    parser.add_argument("--truths", nargs="+", choices=("original", "sfm"), help="only under these ground truths")


def find_truths(args: argparse.Namespace) -> tuple[str, ...]:
    """The ground truths that the arguments ask for. Also: one thread, and nothing of Lightning's own printed."""
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    return tuple(args.truths or (("original", "sfm") if args.pgt else ("original",)))


def print_table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print rows as Markdown."""
    for row in (head, ["---"] * len(head), *rows):
        print(f"| {' | '.join(map(str, row))} |", flush=True)
