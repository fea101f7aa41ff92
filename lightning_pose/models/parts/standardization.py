"""StandardizedModule: networks that read and return numbers in standard deviations around the training mean."""

from __future__ import annotations

import torch
from lightning import LightningModule
from torch import Tensor

from lightning_pose.geometry.quaternions import mean_quat
from lightning_pose.models.parts.scaling import measure_columns, measure_poses

__all__ = ["StandardizedModule"]


class StandardizedModule(LightningModule):
    """Mixin of `PoseModule`: the scales of features and poses, as buffers, and what they are learnt from.

    Attributes:
        input_shape: shape of one frame's features.
        standardize: whether the network returns poses in standard deviations.
        standardize_features: whether it reads features in standard deviations.
    """

    input_shape: tuple[int, ...]
    standardize: bool
    standardize_features: bool
    pose_mean: Tensor
    pose_scale: Tensor
    quat_reference: Tensor
    feature_mean: Tensor
    feature_scale: Tensor

    def register_scales(self) -> None:
        """Add the buffers; until `fit` they change nothing."""
        self.register_buffer("pose_mean", torch.zeros(7))
        self.register_buffer("pose_scale", torch.ones(7))
        self.register_buffer("quat_reference", torch.tensor([1.0, 0.0, 0.0, 0.0]))
        columns = [1] * len(self.input_shape)
        columns[self.feature_axis] = self.input_shape[self.feature_axis]
        self.register_buffer("feature_mean", torch.zeros(columns))
        self.register_buffer("feature_scale", torch.ones(columns))

    @property
    def feature_axis(self) -> int:
        """The axis of `input_shape` with the columns to standardize, counted from the last."""
        return -1

    def standardize_input(self, features: Tensor) -> Tensor:
        """Features in standard deviations around their mean; as they are without `standardize_features`.

        Of sets of descriptors (N, D), the rows of zeros that fill up a frame with fewer features stay zero.
        """
        if not self.standardize_features:
            return features
        standardized = (features - self.feature_mean) / self.feature_scale
        return standardized * features.any(-1, keepdim=True) if len(self.input_shape) == 2 else standardized

    def unscale_pose(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """The network's (..., 7) numbers as local positions (..., 3) and quaternions (..., 4)."""
        pose = pose * self.pose_scale + self.pose_mean
        return pose[..., :3], pose[..., 3:]

    def fit_scale(self, position: Tensor, quat_wxyz: Tensor) -> None:
        """Learn the hemisphere of the targets, and with `standardize` their mean and spread.

        Args:
            position: (M, 3) of training, local.
            quat_wxyz: (M, 4) of training.
        """
        self.quat_reference.copy_(mean_quat(quat_wxyz))
        if self.standardize:
            mean, spread = measure_poses(position, quat_wxyz, self.quat_reference)
            self.pose_mean.copy_(mean)
            self.pose_scale.copy_(spread)

    def fit_feature_scale(self, features: Tensor) -> None:
        """With `standardize_features`, learn each column's mean and spread from (M, *input_shape) training features."""
        found = measure_columns(features, self.feature_axis) if self.standardize_features else None
        if found is not None:
            self.feature_mean.copy_(found[0].view_as(self.feature_mean))
            self.feature_scale.copy_(found[1].view_as(self.feature_scale))
