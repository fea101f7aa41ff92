"""SceneDataModule: what the data modules share, from the scene to the features of a split in memory."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from lightning import LightningDataModule, Trainer
from torch.utils.data import DataLoader

from lightning_pose.checkpoint import Spec, describe_object
from lightning_pose.data.batches import PoseBatch, PoseDataset, make_loader
from lightning_pose.errors import ConfigError, DataError
from lightning_pose.features import FeatureCache, FeatureExtractor
from lightning_pose.features.cache import FillReport
from lightning_pose.features.fill_cluster import fill_on_cluster
from lightning_pose.geometry.camera import Camera
from lightning_pose.paths import cache_folder
from lightning_pose.scenes.cameras import make_camera
from lightning_pose.scenes.images import read_image_size
from lightning_pose.scenes.pose_times import ClockOffsetSetting, interpolate_scene
from lightning_pose.scenes.scene import Scene
from lightning_pose.scenes.synthetic import RENDERER_VERSION, render_room

__all__ = ["SceneDataModule", "find_datamodule", "room_folder", "scene_datamodule"]


def room_folder(seed: int, frames: int) -> Path:
    """The synthetic room of that seed in the user's cache, rendered on first use."""
    folder = cache_folder("rooms") / f"room-{seed}-{frames}-v{RENDERER_VERSION}"
    return render_room(folder, seed, frames)


class SceneDataModule(LightningDataModule):
    """Base class of the data modules: one scene, its cached features, and batches of them.

    A subclass defines `_load_scene` and `train_dataloader`. If its items are not single frames, it also overrides
    `_make_dataset`, and sets `gives_clips` if they are clips. It keeps every constructor argument as an attribute of
    the same name.

    Args:
        extractor: what the networks read, such as `lightning_pose.features.SURF`.
        batch_size: items in a training batch.
        eval_batch_size: items in a batch where no gradient is needed.
        cache_dir: where extracted features are kept; the user's cache folder if not given.
        workers: processes or threads that extract features; every core if not given.

    Raises:
        ConfigError: a number is out of its range.
        DataError: the scene cannot be read, or a split that is needed is empty.
    """

    clock_offset_ms: ClockOffsetSetting = 0.0
    """From the images' times to those of their poses, for subclasses that have such a setting."""

    gives_clips: ClassVar[bool] = False
    """Whether an item is a clip (T, ...) of consecutive frames, with poses relative to its first frame."""

    def __init__(
        self,
        extractor: FeatureExtractor,
        batch_size: int,
        eval_batch_size: int,
        cache_dir: str | None,
        workers: int | None,
    ) -> None:
        super().__init__()
        for name, value in (("batch_size", batch_size), ("eval_batch_size", eval_batch_size)):
            if value < 1:
                raise ConfigError(f"data.{name} is {value}; give 1 or more")
        self.extractor = extractor
        self.batch_size = batch_size
        self.eval_batch_size = eval_batch_size
        self.cache_dir = cache_dir
        self.workers = workers
        self.cache = FeatureCache(extractor, cache_dir)
        self._scene: Scene | None = None
        self._datasets: dict[str, PoseDataset] = {}
        self._cameras: dict[int, Camera | None] = {}

    @abstractmethod
    def _load_scene(self) -> Scene:
        """Read the scene, or render it."""

    @property
    def input_shape(self) -> tuple[int, ...]:
        """Shape of one frame's features; the models are built for it."""
        return self.extractor.feature_shape

    @property
    def scene(self) -> Scene:
        """The scene, read (or rendered) on first use."""
        if self._scene is None:
            self._scene = self._load_scene()
            if self.clock_offset_ms == "auto":
                from lightning_pose.data.clock import find_clock_offset_ms  # it needs this class

                self._scene = interpolate_scene(self._scene, find_clock_offset_ms(self))
                self._cameras = {}  # numbers of frames may have changed
        return self._scene

    def replace_split(self, split: str, indices: np.ndarray) -> None:
        """Give a split other frames, indices into `Scene.frames`."""
        self._scene = replace(self.scene, splits={**self.scene.splits, split: indices})
        self._datasets.pop(split, None)

    def prepare_data(self) -> None:
        self.fill()

    def fill(self, scheduler: str | None = None) -> FillReport:
        """Extract what the cache lacks, for every split; with a scheduler on its cluster, see `run_tasks`."""
        used = sorted({int(i) for indices in self.scene.splits.values() for i in indices})
        images = [self.scene.frames[i].image for i in used]
        if scheduler is not None:
            return fill_on_cluster(self.cache, images, scheduler, self.workers)
        return self.cache.fill(images, workers=self.workers)

    def dataset(self, split: str) -> PoseDataset:
        """One of `train`, `val`, `test`, its features in memory."""
        if split not in self._datasets:
            self._datasets[split] = self._make_dataset(split, self._read(split, self.cache))
        return self._datasets[split]

    def with_extractor(self, extractor: FeatureExtractor) -> SceneDataModule:
        """The same scene, splits and cache folder with another extractor's features."""
        other = copy(self)
        other._scene, other._datasets = self.scene, {}
        other.extractor, other.cache = extractor, FeatureCache(extractor, self.cache_dir)
        return other

    def read_features(self, frames: Sequence[int]) -> torch.Tensor:
        """(M, *input_shape) features of any frames, indices into `Scene.frames`."""
        return torch.from_numpy(self.cache.features([self.scene.frames[i].image for i in frames], self.workers))

    def find_image_size(self, split: str) -> tuple[int, int]:
        """Width and height of the first image of a split."""
        return self.measure_image(int(self.scene.splits[split][0]))

    def measure_image(self, frame: int) -> tuple[int, int]:
        """Width and height of a frame's image, in pixels."""
        return read_image_size(self.scene.frames[frame].image)

    def find_camera(self, frame: int) -> Camera | None:
        """A frame's camera, for its image as it is; None if it is unknown.

        Raises:
            ConfigError: the camera is for images of another shape.
        """
        if frame not in self._cameras:
            about = self.scene.frames[frame]
            known = about.intrinsics
            self._cameras[frame] = known and make_camera(known, *self.measure_image(frame), about.image)
        return self._cameras[frame]

    def _make_dataset(self, split: str, data: PoseBatch) -> PoseDataset:
        """Items of a split, from its frames."""
        return PoseDataset(data)

    def _read(self, split: str, cache: FeatureCache) -> PoseBatch:
        """All frames of a split, features from a cache."""
        frames = [self.scene.frames[i] for i in self.scene.splits[split]]
        return PoseBatch(
            features=torch.from_numpy(cache.features([frame.image for frame in frames], workers=self.workers)),
            position_m=_stack_rows([frame.position_m for frame in frames], 3),
            quat_wxyz=_stack_rows([frame.quat_wxyz for frame in frames], 4).float(),
            frame=torch.as_tensor(self.scene.splits[split], dtype=torch.int64),
        )

    def val_dataloader(self) -> DataLoader[PoseBatch] | list[DataLoader[PoseBatch]]:
        if len(self.scene.splits["val"]):
            return self._eval_loader("val")
        if self.trainer is not None and self.trainer.validating:
            raise DataError(f"{self.scene.root} has no validation frames; give data.val_fraction, such as 0.1")
        return []

    def test_dataloader(self) -> DataLoader[PoseBatch]:
        if not len(self.scene.splits["test"]):
            raise DataError(f"{self.scene.root} has no test frames; give it a test split")
        return self._eval_loader("test")

    predict_dataloader = test_dataloader

    def _eval_loader(self, split: str) -> DataLoader[PoseBatch]:
        return make_loader(self.dataset(split), self.eval_batch_size, shuffle=False)

    def describe(self) -> Spec:
        """Plain settings that rebuild this data module; checkpoints carry them."""
        spec = describe_object(self)
        spec["init_args"]["extractor"] = describe_object(self.extractor)
        return spec


def _stack_rows(rows: list[np.ndarray], width: int) -> torch.Tensor:
    """(N, width) float64 of N rows, also of none."""
    return torch.from_numpy(np.asarray(rows, dtype=np.float64).reshape(-1, width))


def find_datamodule(trainer: Trainer) -> SceneDataModule | None:
    """The trainer's data module; None if it has none, or one that is no `SceneDataModule`."""
    datamodule = getattr(trainer, "datamodule", None)  # Lightning does not declare the attribute
    return datamodule if isinstance(datamodule, SceneDataModule) else None


def scene_datamodule(trainer: Trainer) -> SceneDataModule:
    """The trainer's data module.

    Raises:
        ConfigError: the trainer has none, or one that is no `SceneDataModule`.
    """
    datamodule = find_datamodule(trainer)
    if datamodule is None:
        given = getattr(trainer, "datamodule", None)
        raise ConfigError(
            f"the trainer's data module is {'missing' if given is None else 'a ' + type(given).__name__}; give it "
            "datamodule=, such as lightning_pose.data.ImageDataModule"
        )
    return datamodule
