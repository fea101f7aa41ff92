"""LandmarkMap: keypoints of the training frames, triangulated; images are located by matching and PnP."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, cast

import numpy as np
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor, nn

from lightning_pose.data.batches import PoseBatch, PoseDataset
from lightning_pose.data.datamodule import SceneDataModule, scene_datamodule
from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.camera import Camera
from lightning_pose.geometry.quaternions import quat_normalize
from lightning_pose.mapping.map_localizer import MapAnswer
from lightning_pose.models.base import PoseModule
from lightning_pose.models.parts.answers import Answers, answer_by_map, convert_answers, localize_prior
from lightning_pose.models.parts.frame_cameras import list_cameras, scale_cameras
from lightning_pose.models.parts.map_builder import BundleAdjust, MapBuilder, check_bundle_adjust, check_keypoints
from lightning_pose.models.parts.map_extender import KnownMap, MapExtender, read_known_map
from lightning_pose.models.parts.map_network import RESIZED, MapNetwork
from lightning_pose.models.parts.memory import TrainingMemory
from lightning_pose.models.parts.poses import Located

__all__ = ["LandmarkMap"]


class LandmarkMap(TrainingMemory, PoseModule):
    """A map of triangulated keypoints, in which an image is located by matching, RANSAC and refinement.

    Not in the thesis: its features are those of SurfCNN and SurfLSTM with their places in the image. One pass over
    the training frames builds the map; there is nothing to train in steps.

    Each frame has its own camera: the dataset's, or `data.camera`. Where none is known, all have the focal length that
    fits the training poses best.

    Args:
        bundle_adjust: `true` moves the training poses until they agree with the images, and carries answers back to
            the given poses; `auto` does so if validation frames (without them, training frames left out in turn) are
            located better; `false` takes the poses as they are.
        extends: checkpoint of a `LandmarkMap` whose map gets the training frames of another recording of the scene, in
            the same world, with the same features. Its points and frames stay where they are, and it is not adjusted
            again: `bundle_adjust` is not used.
        refit: build the map again with the validation frames among the training frames. The validation metrics stay
            those of the map without.
        **kwargs: what `PoseModule` takes. `loss` is only logged; learning rate, decay and schedule are ignored.

    Raises:
        ConfigError: `bundle_adjust` is not understood; in `setup`, the features are not keypoints with their
            geometry.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (2,)
    refusal: ClassVar[str] = "is a map itself"
    memory: ClassVar[tuple[str, ...]] = tuple(f"network.{name}" for name in RESIZED)
    network: MapNetwork

    def __init__(
        self,
        bundle_adjust: BundleAdjust = "auto",
        extends: str | None = None,
        refit: bool = True,
        standardize: bool = False,
        standardize_features: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(standardize=standardize, standardize_features=standardize_features, **kwargs)
        self.automatic_optimization = False
        check_bundle_adjust(bundle_adjust)
        self.bundle_adjust: BundleAdjust = bundle_adjust
        self.extends = extends
        self._known: KnownMap | None = None
        self.refit = refit
        self.network = MapNetwork(self.input_shape[1] - 4)
        # Several processes can only train what has a parameter, although each of them builds the whole map.
        camera = self.network.get_buffer("camera")
        del self.network.camera
        self.network.camera = nn.Parameter(camera)

    @property
    def headline(self) -> str:
        return f"N={self.input_shape[0]}"

    @property
    def training_splits(self) -> tuple[str, ...]:
        return ("train", "val") if self.refit else ("train",)

    def check_data(self, datamodule: SceneDataModule) -> None:
        """Also refuse features that are no keypoints, or come without their places in the image."""
        super().check_data(datamodule)
        check_keypoints(datamodule.extractor)

    def fit_world_frame(self, train: PoseDataset) -> None:
        """That of the map that is extended, or as for others.

        Raises:
            CheckpointError, ConfigError: as `read_known_map`.
        """
        if self.extends is None:
            super().fit_world_frame(train)
            return
        self._known = read_known_map(self.extends, scene_datamodule(self.trainer))
        self.world_frame.set_extra_state(self._known.world_frame.get_extra_state())

    def configure_optimizers(self) -> torch.optim.Optimizer:
        # There is nothing to step along, but Lightning writes no checkpoint before some optimizer has stepped.
        return torch.optim.SGD([torch.zeros(1, requires_grad=True)])

    def training_step(self, batch: PoseBatch, batch_idx: int) -> None:
        if self.trainer.is_last_batch:  # before the validation that closes the epoch
            self._builder = self._make_builder()
            self._builder.build(("train",), calibrate=not self._refits)
            cast(LightningOptimizer, self.optimizers()).step()

    @torch.no_grad()
    def on_train_epoch_end(self) -> None:
        # Validation is over, and checkpoints are not written yet.
        datamodule = scene_datamodule(self.trainer)
        if self._refits:
            self._builder.build(("train", "val"), calibrate=True)
        train = datamodule.dataset("train")
        sample = list(range(0, len(train), max(1, len(train) // 50)))
        batch = self.localize_batch(train.__getitems__(sample))
        self._train_step(PoseBatch(*(part.to(self.device) for part in batch)))
        super().on_train_epoch_end()
        self.trainer.should_stop = True  # further epochs would find the same

    @property
    def _refits(self) -> bool:
        """Whether the map is built again with validation frames."""
        return self.refit and len(scene_datamodule(self.trainer).scene.splits["val"]) > 0

    def _make_builder(self) -> MapBuilder:
        datamodule = scene_datamodule(self.trainer)
        if self._known is not None:
            return MapExtender(self._known, self.network, datamodule, self.print)
        return MapBuilder(self.network, datamodule, self.world_frame, self.bundle_adjust, self.print)

    def decode_batch(self, batch: PoseBatch) -> tuple[Tensor, Tensor]:
        """As `decode_features`, each frame with its own camera."""
        features = self.standardize_input(batch.features)
        return self.unscale_pose(self.network(features, self._list_cameras(batch.frame)))

    def predict_step(self, batch: PoseBatch, batch_idx: int) -> Located:
        position, quat = self.decode_batch(batch)
        return Located(batch.frame, self.world_frame.to_world(position), quat_normalize(quat))

    def locate_frames(self, batch: PoseBatch) -> list[MapAnswer]:
        """What the map says of frames of the trainer's data module, in the map's own unit."""
        return self.network.locate(batch.features, self._list_cameras(batch.frame))

    def find_refused(self, batch: PoseBatch) -> np.ndarray:
        return np.array([not answer.accepted for answer in self.locate_frames(batch)], bool)

    @property
    def map_network(self) -> MapNetwork | None:
        return self.network if len(self.network.position) else None

    def locate_images(
        self,
        features: Tensor,
        sizes: Sequence[tuple[int, int]],
        camera: Camera | None = None,
        keypoints: Tensor | None = None,
        prior: CameraPose | None = None,
    ) -> Answers:
        """As any system, with the reason where the map refuses; `keypoints` are the features themselves."""
        cameras = scale_cameras(self.network.view if camera is None else camera, sizes)
        found = self.network.locate(features, cameras, localize_prior(prior, self.world_frame))
        return answer_by_map(convert_answers(found, self.world_frame), found, self.network, self.world_frame.scale)

    def _list_cameras(self, frames: Tensor) -> list[Camera] | None:
        """The cameras of frames of the trainer's data module, the map's for unknown ones; None without a map."""
        if self.map_network is None:
            return None
        return list_cameras(scene_datamodule(self.trainer), frames.tolist(), self.network.view)
