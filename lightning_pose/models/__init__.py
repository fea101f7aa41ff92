"""The architectures, one file each; the docstring of `PoseModule` explains how to add another."""

from lightning_pose.models.base import Pose, PoseModule
from lightning_pose.models.clip import ClipModule
from lightning_pose.models.cnn_3d import CNN3D
from lightning_pose.models.cnn_rnn import CNNRNN
from lightning_pose.models.dense_posenet import DensePoseNet
from lightning_pose.models.graph_pose import GraphPose
from lightning_pose.models.kernel_posenet import KernelPoseNet
from lightning_pose.models.linear_posenet import LinearPoseNet
from lightning_pose.models.node_pose import NodePose
from lightning_pose.models.posenet import PoseNet
from lightning_pose.models.surf_cnn import SurfCNN
from lightning_pose.models.surf_lstm import SurfLSTM

__all__ = [
    "CNN3D",
    "CNNRNN",
    "ClipModule",
    "DensePoseNet",
    "GraphPose",
    "KernelPoseNet",
    "LinearPoseNet",
    "NodePose",
    "Pose",
    "PoseModule",
    "PoseNet",
    "SurfCNN",
    "SurfLSTM",
]
