"""LandmarkMap: keypoints of the training frames, triangulated; images are located by matching and PnP."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, cast

import numpy as np
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from scipy.spatial.transform import Rotation

from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.datamodule import SceneDataModule, scene_datamodule
from lightning_pose.errors import ConfigError, DataError
from lightning_pose.features.base import LocalExtractor
from lightning_pose.geometry.camera import Camera
from lightning_pose.mapping.build_map import MappedFrames, adjust_mapped, map_frames, summarize_tracks
from lightning_pose.mapping.calibration import UNKNOWN, calibrate_map, measure_frames
from lightning_pose.mapping.conventions import fit_focal_length
from lightning_pose.mapping.frame_matches import match_nearby_frames
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.map_localizer import MapLocalizer
from lightning_pose.models.base import PoseModule
from lightning_pose.models.parts.map_network import MAP_SHAPES, MapNetwork, keypoints_to_frames
from lightning_pose.models.parts.memory import TrainingMemory

__all__ = ["LandmarkMap"]


class LandmarkMap(TrainingMemory, PoseModule):
    """A map of triangulated keypoints, in which an image is located by matching, RANSAC and refinement.

    Not in the thesis: its features are those of SurfCNN and SurfLSTM with their places in the image. One pass over
    the training frames builds the map; there is nothing to train in steps.

    Args:
        camera: `MODEL,WIDTH,HEIGHT,PARAMETERS...` in COLMAP's notation, such as `PINHOLE,640,480,525,525,320,240`, for
            images that carry none; the centre of the first pixel is (0, 0). Without it, the dataset's camera is used,
            and if it has none, the focal length that fits the poses best.
        bundle_adjust: `true` moves the training poses until they agree with the images, and carries answers back to
            the given poses; `auto` does so if validation frames (without them, training frames left out in turn) are
            located better; `false` takes the poses as they are.
        refit: build the map again with the validation frames among the training frames. The validation metrics stay
            those of the map without.
        **kwargs: what `PoseModule` takes. `loss` is only logged; learning rate, decay and schedule are ignored.

    Raises:
        ConfigError: `camera` or `bundle_adjust` is not understood; in `setup`, the features are not keypoints
            with their geometry.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (2,)
    memory: ClassVar[tuple[str, ...]] = tuple(f"network.{name}" for name in MAP_SHAPES if name != "camera")
    network: MapNetwork

    def __init__(
        self,
        camera: str | None = None,
        bundle_adjust: bool | Literal["auto"] = "auto",
        refit: bool = True,
        standardize: bool = False,
        standardize_features: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(standardize=standardize, standardize_features=standardize_features, **kwargs)
        self.automatic_optimization = False
        self.camera = None if camera is None else Camera.parse(camera)
        if bundle_adjust not in (True, False, "auto"):
            raise ConfigError(f"bundle_adjust is {bundle_adjust!r}; give true, false or auto")
        self.bundle_adjust = bundle_adjust
        self.refit = refit
        self.network = MapNetwork(self.input_shape[1] - 4)
        self._adjusts = bundle_adjust is True

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

    def _build(self, splits: tuple[str, ...], calibrate: bool) -> None:
        """Build the map of the frames of these splits; unless it is only to be validated, find its radii too.

        Raises:
            DataError: the frames give no point.
        """
        datamodule = scene_datamodule(self.trainer)
        camera = self._find_camera(datamodule)
        frames = self._read_frames(datamodule, splits, camera)
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
        """Keypoints and given poses of the frames of these splits, in the order of the scene."""
        data = [datamodule.dataset(split).data for split in splits]
        index = torch.cat([part.frame for part in data])
        order = index.argsort()
        frames = [datamodule.scene.frames[i] for i in index[order].tolist()]
        quats = np.array([frame.quat_wxyz for frame in frames])
        return keypoints_to_frames(
            torch.cat([part.features for part in data])[order],
            camera,
            Rotation.from_quat(quats, scalar_first=True).as_matrix(),
            self.world_frame.to_local(torch.from_numpy(np.array([frame.position_m for frame in frames]))).numpy(),
        )

    def _find_camera(self, datamodule: SceneDataModule) -> Camera:
        """The camera of the setting, of the dataset, or with the focal length that fits the training poses."""
        scene = datamodule.scene
        first = scene.frames[int(scene.splits["train"][0])]
        width, height = datamodule.find_image_size("train")
        if self.camera is not None:
            return self.camera.resize(width, height)
        if first.intrinsics is not None:
            known = first.intrinsics.for_size(width, height)
            return Camera(width, height, known.fx, known.fy, known.cx, known.cy, known.distortion, known.fisheye)
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
                "or no motion); give model.camera, such as PINHOLE,640,480,525,525,320,240"
            )
        self.print(
            f"the camera is unknown: a focal length of {focal_px:.0f} px fits the poses best (matches lie "
            f"{residual_px:.2f} px off their epipolar lines); model.camera sets another"
        )
        return Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
