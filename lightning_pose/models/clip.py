"""ClipModule: what the architectures for clips of consecutive frames share."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from lightning_pose.data.batches import PoseDataset
from lightning_pose.data.clip_datamodule import require_clips
from lightning_pose.data.clip_dataset import ClipDataset
from lightning_pose.data.datamodule import SceneDataModule, scene_datamodule
from lightning_pose.errors import ConfigError
from lightning_pose.geometry.quaternions import quat_normalize, relative_pose
from lightning_pose.geometry.relative import chain_steps
from lightning_pose.models.base import Pose, PoseModule
from lightning_pose.models.parts.motion import GEOMETRY_COLUMNS, MOTION_COLUMNS, measure_motion

__all__ = ["ClipModule"]


class ClipModule(PoseModule):
    """Base class of the architectures that read clips (B, T, *input_shape), any T, and return each frame's pose.

    Poses are relative to the clip's first frame (eq. 6.1), (B, T, 3) and (B, T, 4). `self.network` takes (B, T, C, H,
    W) and returns (B, T, 7); descriptors (N, D) are an image of one channel to it, raw images have three. Metrics
    leave out the first frame, whose pose is known.

    Args:
        integrate: let the network predict each frame's pose relative to the frame before it, and compose them. The
            thesis's networks predict the pose relative to the first frame at once, which a frame and its neighbours
            in time do not show. For `data.relative_frame: camera`.
        motion: let the network read how features moved since the frame before (`measure_motion`) instead of their
            descriptors. The descriptors of a new scene hold no information on motion, and their order even less.
            For descriptors `with_geometry`.
        **kwargs: what `PoseModule` takes.

    Raises:
        ConfigError: `motion` without geometry; in `fit`, `integrate` where relative positions are in world axes.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (2, 3)
    reads_clips: ClassVar[bool] = True
    refusal: ClassVar[str] = "returns poses relative to a clip's first frame, where a map's are in the world"

    motion_scale: Tensor

    def __init__(self, integrate: bool = False, motion: bool = False, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.integrate = integrate
        self.motion = motion
        if motion and (len(self.input_shape) != 2 or self.input_shape[1] <= GEOMETRY_COLUMNS):
            raise ConfigError(
                f"model.motion needs descriptors with their places, not features of shape {self.input_shape}; "
                "give local features with_geometry: true as data.extractor"
            )
        self.register_buffer("motion_scale", torch.ones(MOTION_COLUMNS))

    @property
    def feature_axis(self) -> int:
        """Columns of descriptors, channels of images."""
        return -3 if len(self.input_shape) == 3 else -1

    @property
    def image_shape(self) -> tuple[int, int, int]:
        """Channels, height and width of a frame, as the network reads it."""
        if self.motion:
            return MOTION_COLUMNS, self.input_shape[0], 1  # so that a filter covers all columns of a move
        channels, height, width = (1, *self.input_shape)[-3:]
        return channels, height, width

    @property
    def headline(self) -> str:
        shape = f"N={self.input_shape[0]}" if len(self.input_shape) == 2 else "x".join(map(str, self.input_shape))
        return shape + " motion" * self.motion + " integrated" * self.integrate

    def check_data(self, datamodule: SceneDataModule) -> None:
        super().check_data(datamodule)
        frame = require_clips(datamodule).relative_frame
        if self.integrate and frame != "camera":
            raise ConfigError(
                f"model.integrate composes camera motions, but data.relative_frame is {frame}; set camera"
            )

    def setup(self, stage: str) -> None:
        super().setup(stage)
        if stage == "fit" and self.motion:
            self.fit_motion_scale(scene_datamodule(self.trainer).dataset("train"))

    def fit_motion_scale(self, train: PoseDataset) -> None:
        """Learn how far features move, from 64 training clips at most."""
        chosen = range(0, len(train), -(-len(train) // 64))
        rows = measure_motion(train.__getitems__(chosen).features).flatten(0, 2)
        rows = rows[rows.any(1)]
        if len(rows) > 1:
            self.motion_scale.copy_(rows.square().mean(0).sqrt().clamp(min=1e-6))

    def fit_world_frame(self, train: PoseDataset) -> None:
        """Choose the scale of the positions of the training split, each run of frames around its own mean."""
        assert isinstance(train, ClipDataset)
        runs = (train.data.position_m[torch.from_numpy(run)] for run in train.runs)
        self.world_frame.fit(torch.cat([run - run.mean(0) for run in runs]))

    def training_poses(self, train: PoseDataset) -> tuple[Tensor, Tensor]:
        """Relative poses of all clips without their first frames, or with `integrate` those of each step."""
        position_m, quat_wxyz = train.targets()
        quat_wxyz = quat_wxyz.to(position_m.dtype)
        if self.integrate:
            before = position_m[:, :-1], quat_wxyz[:, :-1]
            position_m, quat_wxyz = relative_pose(*before, position_m[:, 1:], quat_wxyz[:, 1:])
        else:
            position_m, quat_wxyz = position_m[:, 1:], quat_wxyz[:, 1:]
        return position_m.flatten(0, 1), quat_wxyz.flatten(0, 1)

    def decode_features(self, features: Tensor) -> tuple[Tensor, Tensor]:
        if self.motion:
            read = (measure_motion(features) / self.motion_scale).transpose(2, 3)
        else:
            read = self.standardize_input(features)
        images = read.reshape(*features.shape[:2], *self.image_shape)
        position_m, quat_raw = self.unscale_pose(self.network(images))
        if self.integrate:
            return chain_steps(position_m[:, 1:], quat_normalize(quat_raw[:, 1:]))
        return position_m, quat_raw

    def select_judged(self, pose: Pose) -> Pose:
        """All frames but the first of each clip, whose pose is known."""
        return Pose(pose.position_m[:, 1:], pose.quat_wxyz[:, 1:])
