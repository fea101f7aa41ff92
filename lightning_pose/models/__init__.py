"""The architectures, one file each; `base` says how to add another."""

from lightning_pose.models.base import Pose, PoseModule
from lightning_pose.models.surf_cnn import SurfCNN
from lightning_pose.models.surf_lstm import SurfLSTM

__all__ = ["Pose", "PoseModule", "SurfCNN", "SurfLSTM"]
