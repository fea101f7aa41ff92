"""LandmarkMap: keypoints of the training frames, triangulated; images are located by matching and PnP."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal, cast

import numpy as np
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from scipy.spatial.transform import Rotation
from torch import Tensor

from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.datamodule import SceneDataModule, scene_datamodule
from lightning_pose.errors import ConfigError, DataError
from lightning_pose.features.base import LocalExtractor
from lightning_pose.geometry.camera import Camera
from lightning_pose.geometry.quaternions import quat_normalize
from lightning_pose.mapping.build_map import MappedFrames, adjust_mapped, map_frames, summarize_tracks
from lightning_pose.mapping.calibration import UNKNOWN, calibrate_map, measure_frames
from lightning_pose.mapping.conventions import fit_focal_length
from lightning_pose.mapping.frame_matches import match_nearby_frames
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.map_localizer import MapAnswer, MapLocalizer
from lightning_pose.models.base import PoseModule
from lightning_pose.models.parts.frame_cameras import find_frequent_camera, list_cameras
from lightning_pose.models.parts.map_network import MAP_SHAPES, MapNetwork, keypoints_to_frames
from lightning_pose.models.parts.memory import TrainingMemory
from lightning_pose.models.parts.poses import Located, Pose
from lightning_pose.scenes.cameras import scale_camera

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
        refit: build the map again with the validation frames among the training frames. The validation metrics stay
            those of the map without.
        **kwargs: what `PoseModule` takes. `loss` is only logged; learning rate, decay and schedule are ignored.

    Raises:
        ConfigError: `bundle_adjust` is not understood; in `setup`, the features are not keypoints with their
            geometry.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (2,)
    memory: ClassVar[tuple[str, ...]] = tuple(f"network.{name}" for name in MAP_SHAPES if name != "camera")
    network: MapNetwork

    def __init__(
        self,
        bundle_adjust: bool | Literal["auto"] = "auto",
        refit: bool = True,
        standardize: bool = False,
        standardize_features: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(standardize=standardize, standardize_features=standardize_features, **kwargs)
        self.automatic_optimization = False
        if bundle_adjust not in (True, False, "auto"):
            raise ConfigError(f"bundle_adjust is {bundle_adjust!r}; give true, false or auto")
        self.bundle_adjust = bundle_adjust
        self.refit = refit
        self.network = MapNetwork(self.input_shape[1] - 4)
        self._adjusts = bundle_adjust is True
        self._camera: Camera | None = None

    @property
    def headline(self) -> str:
        return f"N={self.input_shape[0]}"

    @property
    def training_splits(self) -> tuple[str, ...]:
        return ("train", "val") if self.refit else ("train",)

    def check_data(self, datamodule: SceneDataModule) -> None:
        """Also refuse features that are no keypoints, or come without their places in the image."""
        super().check_data(datamodule)
        extractor = datamodule.extractor
        if not isinstance(extractor, LocalExtractor) or not extractor.with_geometry:
            raise ConfigError(
                f"LandmarkMap needs keypoints with their places, and {extractor.name} features have none; "
                "choose lightning_pose.features.SURF (or SIFT, ORB, FREAK, BRIEF), and set "
                "data.extractor.with_geometry: true"
            )

    def configure_optimizers(self) -> torch.optim.Optimizer:
        # There is nothing to step along, but Lightning writes no checkpoint before some optimizer has stepped.
        return torch.optim.SGD([torch.zeros(1, requires_grad=True)])

    def training_step(self, batch: PoseBatch, batch_idx: int) -> None:
        if self.trainer.is_last_batch:  # before the validation that closes the epoch
            self._camera = self._find_camera(scene_datamodule(self.trainer))
            self._build(("train",), calibrate=not self._refits)
            cast(LightningOptimizer, self.optimizers()).step()

    @torch.no_grad()
    def on_train_epoch_end(self) -> None:
        # Validation is over, and checkpoints are not written yet.
        datamodule = scene_datamodule(self.trainer)
        if self._refits:
            self._build(("train", "val"), calibrate=True)
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

    def locate_images(self, features: Tensor, sizes: Sequence[tuple[int, int]], camera: Camera | None = None) -> Pose:
        known = self.network.view if camera is None else camera
        cameras = [scale_camera(known, *size, setting="camera") for size in sizes]
        position, quat = self.unscale_pose(self.network(self.standardize_input(features), cameras))
        return Pose(self.world_frame.to_world(position), quat_normalize(quat))

    def _list_cameras(self, frames: Tensor, fallback: Camera | None = None) -> list[Camera]:
        """The cameras of frames of the trainer's data module, for their images as they are.

        Frames whose camera is unknown have the fallback's, or else that of the map.
        """
        fallback = self.network.view if fallback is None else fallback
        return list_cameras(scene_datamodule(self.trainer), frames.tolist(), fallback)

    def _build(self, splits: tuple[str, ...], calibrate: bool) -> None:
        """Build the map of the frames of these splits; unless it is only to be validated, find its radii too.

        Raises:
            DataError: the frames give no point.
        """
        datamodule = scene_datamodule(self.trainer)
        assert self._camera is not None
        frames, camera = self._read_frames(datamodule, splits, self._camera), self._camera
        mapped = map_frames(frames, adjust=False)
        if self.bundle_adjust is not False:
            mapped = self._choose_adjusted(mapped, datamodule, camera, decided=splits != ("train",))
        if not len(mapped.tracks.points):
            raise DataError(
                f"no point of {datamodule.scene.root} could be triangulated from {len(frames)} frames; "
                "`python -m lightning_pose check` says whether the poses fit the images"
            )
        point_map, calibration = summarize_tracks(mapped), calibrate_map(mapped) if calibrate else UNKNOWN
        self.network.set_map(point_map, camera, calibration)
        if calibrate:
            error_m = calibration.position_error * self.world_frame.scale
            self.print(
                f"map of {len(frames)} frames: {len(point_map)} points, {point_map.n_bytes / 1e6:.1f} MB, "
                f"bundle adjustment {'on' if self._adjusts else 'off'}; training frames left out in turn are located "
                f"to {error_m:.3g} {datamodule.scene.unit} and {calibration.orientation_error_deg:.2f} degrees (median)"
            )

    def _choose_adjusted(
        self, mapped: MappedFrames, datamodule: SceneDataModule, camera: Camera, decided: bool
    ) -> MappedFrames:
        """The map after bundle adjustment, or as it was where that locates validation frames better."""
        if self.bundle_adjust == "auto" and decided and not self._adjusts:
            return mapped
        adjusted = adjust_mapped(mapped)
        if self.bundle_adjust == "auto" and not decided:
            if len(datamodule.scene.splits["val"]):
                val = self._read_frames(datamodule, ("val",), camera)
                before, after = (
                    np.median(measure_frames(MapLocalizer(summarize_tracks(each)), val).position)
                    for each in (mapped, adjusted)
                )
            else:
                before, after = (calibrate_map(each).position_error for each in (mapped, adjusted))
            self._adjusts = bool(after < before)
        return adjusted if self._adjusts else mapped

    def _read_frames(self, datamodule: SceneDataModule, splits: tuple[str, ...], camera: Camera) -> MapFrames:
        """Keypoints and given poses of the frames of these splits, in the order of the scene.

        `camera` is that of frames whose own is unknown.
        """
        data = [datamodule.dataset(split).data for split in splits]
        index = torch.cat([part.frame for part in data])
        order = index.argsort()
        frames = [datamodule.scene.frames[i] for i in index[order].tolist()]
        quats = np.array([frame.quat_wxyz for frame in frames])
        return keypoints_to_frames(
            torch.cat([part.features for part in data])[order],
            self._list_cameras(index[order], camera),
            Rotation.from_quat(quats, scalar_first=True).as_matrix(),
            self.world_frame.to_local(torch.from_numpy(np.array([frame.position_m for frame in frames]))).numpy(),
        )

    def _find_camera(self, datamodule: SceneDataModule) -> Camera:
        """The most frequent camera of the training frames, or one with the focal length that fits their poses."""
        camera, count = find_frequent_camera(datamodule, datamodule.scene.splits["train"].tolist())
        if count > 1:
            self.print(f"{count} cameras; images that come without one are located as if by {camera}")
        return self._fit_camera(datamodule) if camera is None else camera

    def _fit_camera(self, datamodule: SceneDataModule) -> Camera:
        """The camera with the focal length that fits the training poses best.

        Raises:
            ConfigError: too few matches, or no motion.
        """
        scene = datamodule.scene
        width, height = datamodule.find_image_size("train")
        guess = Camera(width, height, 1.0, 1.0, (width - 1) / 2, (height - 1) / 2)
        frames = self._read_frames(datamodule, ("train",), guess)
        sequences = [scene.frames[i].sequence for i in datamodule.dataset("train").data.frame.tolist()]
        matches = match_nearby_frames(
            sequences,
            lambda i: (frames.points[i, : frames.count[i]], frames.descriptors[i, : frames.count[i]]),
        )
        _, residual_px, focal_px = fit_focal_length(matches, frames.rotation, frames.position, max(width, height))
        if not np.isfinite(residual_px):
            raise ConfigError(
                f"the camera of {scene.root} is unknown, and its frames do not tell the focal length (too few matches, "
                "or no motion); give data.camera, such as PINHOLE,640,480,525,525,320,240"
            )
        self.print(
            f"the camera is unknown: a focal length of {focal_px:.0f} px fits the poses best (matches lie "
            f"{residual_px:.2f} px off their epipolar lines); data.camera sets another"
        )
        return Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
