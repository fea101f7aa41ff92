"""RefinedModule: regressors with a landmark map beside them, from its building to the poses that it replaces."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar, cast

import numpy as np
import torch
from torch import Tensor

from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.datamodule import SceneDataModule, scene_datamodule
from lightning_pose.errors import CheckpointError, ConfigError, DataError
from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.camera import Camera
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m
from lightning_pose.models.parts.answers import (
    Answers,
    answer_by_map,
    answer_by_network,
    localize_prior,
    replace_accepted,
)
from lightning_pose.models.parts.checkpoint_hooks import CheckpointHooks
from lightning_pose.models.parts.error_radius import ErrorRadius
from lightning_pose.models.parts.frame_cameras import scale_cameras
from lightning_pose.models.parts.map_network import MapNetwork
from lightning_pose.models.parts.poses import Pose
from lightning_pose.models.parts.refinement import MapRefinement, MapSettings
from lightning_pose.models.parts.world_frame import WorldFrame

__all__ = ["RefinedModule"]

PREFIX = "refinement."

CHUNK = 64
"""Frames that are measured at once."""

_log = logging.getLogger("lightning_pose")


class RefinedModule(CheckpointHooks):
    """Mixin of `PoseModule`: with `refine`, a frame has the pose of a landmark map where the map accepts it.

    The regressor is trained as without. The map is built of the frames that the regressor learns from, before its
    first step; if it learns from validation frames in the end, the map is then built again with them. Losses are of
    the regressor alone, errors are of the refined poses. Frames of which no map can be built leave the regressor alone.

    Attributes:
        refinement: the map; None without `refine`.
        radius: of the errors of the regressor's own poses; None for architectures that take no map.
        refusal: why this architecture takes no map; empty where it does.
    """

    refusal: ClassVar[str] = ""
    refinement: MapRefinement | None
    radius: ErrorRadius | None
    input_shape: tuple[int, ...]
    world_frame: WorldFrame

    def register_refinement(self, refine: bool | MapSettings | Mapping[str, Any], limit: float | None) -> None:
        """Add the map that is asked for, empty, and what measures distances to training images.

        Args:
            refine: settings of the map.
            limit: as `distance_limit` of `PoseModule`.

        Raises:
            ConfigError: the architecture takes no map, or the limit is out of its range.
        """
        if limit is not None and not limit > 0:
            raise ConfigError(f"distance_limit is {limit}; give a number above 0, such as 1.25, or null to refuse none")
        settings = MapSettings.parse(refine)
        if settings is not None and self.refusal:
            raise ConfigError(f"model.refine is on, but {type(self).__name__} {self.refusal}; leave it out")
        self.hparams["refine"] = False if settings is None else asdict(settings)
        self.refinement = None if settings is None else MapRefinement(settings)
        self.radius = None if self.refusal else ErrorRadius(self.input_shape, limit)

    @property
    def system_name(self) -> str:
        """The architecture's name, and whether its poses are refined."""
        return f"{type(self).__name__} refined" if self.refinement is not None else type(self).__name__

    def attach_refinement(self, datamodule: SceneDataModule | None) -> None:
        """Let the map take keypoints of the trainer's frames.

        Raises:
            ConfigError: the trainer has no data module.
        """
        if self.refinement is not None:
            self.refinement.attach(datamodule or scene_datamodule(self.trainer), self.world_frame, self.print)

    def on_train_start(self) -> None:
        """Build the map that validation frames are located in, unless the run goes on with one."""
        if self.refinement is not None and not (self.refinement.has_map and self.trainer.current_epoch):
            self._fit_refinement(self.refinement, ("train",), calibrate=not self._learns_val)

    def refit_refinement(self) -> None:
        """Build the map again if the regressor has learnt from more frames by now."""
        if self.refinement is not None and self._learns_val:
            self._fit_refinement(self.refinement, self.training_splits, calibrate=True)

    @torch.no_grad()
    def _fit_refinement(self, refinement: MapRefinement, splits: tuple[str, ...], calibrate: bool) -> None:
        try:
            refinement.fit(splits, calibrate)
        except DataError as error:  # no texture, or poses that do not fit the images
            _log.warning("no map refines this %s: %s", type(self).__name__, error)

    def add_errors(self, features: Tensor, pose: Pose, truth: Pose) -> None:
        """Add a validation batch of the regressor's own poses, in the world, to what its radii are found from."""
        if self.radius is not None and len(self.radius.reference) and not self.trainer.sanity_checking:
            errors = (
                position_error_m(pose.position_m, truth.position_m),
                orientation_error_deg(pose.quat_wxyz.double(), truth.quat_wxyz.double()),
            )
            self.radius.add_errors(features, *errors)

    def calibrate_radius(self) -> None:
        """Find the radii from the validation epoch, of which every process has a share."""
        if self.radius is not None and not self.trainer.sanity_checking:
            scores = self.radius.take_scores()
            if self.trainer.world_size > 1:
                scores = cast(Tensor, self.all_gather(scores)).flatten(0, -2)
            if self.trainer.state.fn == "fit":  # other validation frames may be known to the regressor
                self.radius.calibrate(scores)

    @property
    def _learns_val(self) -> bool:
        """Whether there are validation frames that the regressor learns from in the end."""
        return "val" in self.training_splits and len(scene_datamodule(self.trainer).scene.splits["val"]) > 0

    def refine_pose(self, frame: Tensor, pose: Pose) -> Pose:
        """Poses of the trainer's frames, the map's where it accepts.

        Args:
            frame: (B,) indices into `Scene.frames`.
            pose: of the regressor.
        """
        if self.refinement is None or not self.refinement.has_map:
            return pose
        return replace_accepted(pose, self.refinement.locate_frames(frame.tolist()), self.world_frame)

    @torch.inference_mode()
    def find_refused(self, batch: PoseBatch) -> np.ndarray:
        """(B,) bool, which of the trainer's frames are refused: by the map where there is one, else by distance."""
        if self.refinement is not None and self.refinement.has_map:
            return np.array([not answer.accepted for answer in self.refinement.locate_frames(batch.frame.tolist())])
        if self.radius is None:
            return np.zeros(len(batch.frame), bool)
        excess = [self.radius.measure_excess(part.to(self.device)) for part in batch.features.split(CHUNK)]
        return (torch.cat(excess) > 1).numpy()

    @property
    def map_network(self) -> MapNetwork | None:
        """The landmark map of this system; None where it has none, or none yet."""
        return None if self.refinement is None or not self.refinement.has_map else self.refinement.network

    def locate_images(
        self,
        features: Tensor,
        sizes: Sequence[tuple[int, int]],
        camera: Camera | None = None,
        keypoints: Tensor | None = None,
        prior: CameraPose | None = None,
    ) -> Answers:
        """Answers for images from anywhere, as a `Localizer` has them.

        Args:
            features: (B, *input_shape).
            sizes: width and height of each image, in pixels; only maps use them.
            camera: of all images, scaled to each; that of the training images if None.
            keypoints: (B, N, D + 4) of the same images, by the extractor of `refinement`, where there is one.
            prior: where all may have been taken, in the world; only maps use it.

        Raises:
            ConfigError: a camera is given, and there is no map that reads it; or it is for images of another shape.
        """
        if self.refinement is None and camera is not None:
            raise ConfigError(f"{type(self).__name__} does not use cameras; leave camera out")
        pose: Pose = self(features)
        alone = answer_by_network(pose, self.radius, features)
        if self.refinement is None or not self.refinement.has_map or keypoints is None:
            return alone
        network = self.refinement.network
        cameras = scale_cameras(network.view if camera is None else camera, sizes)
        found = network.locate(keypoints, cameras, localize_prior(prior, self.world_frame))
        refined = replace_accepted(pose, found, self.world_frame)
        return answer_by_map(refined, found, network, self.world_frame.scale, alone)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Give the map the checkpoint's size; without `refine`, leave the checkpoint's map out.

        Raises:
            CheckpointError: as `CheckpointHooks`, or `refine` asks for a map, and the checkpoint has none.
        """
        state = checkpoint["state_dict"]
        if self.radius is not None:
            self.radius.resize({name.removeprefix("radius."): value for name, value in state.items()})
        own = {name.removeprefix(PREFIX): value for name, value in state.items() if name.startswith(PREFIX)}
        if self.refinement is None:
            checkpoint["state_dict"] = {name: value for name, value in state.items() if not name.startswith(PREFIX)}
        elif own:
            self.refinement.resize_map(own)
        else:
            raise CheckpointError(
                "model.refine is on, but the checkpoint has no map; leave it out, or train with --model.refine true"
            )
        super().on_load_checkpoint(checkpoint)
