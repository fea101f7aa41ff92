"""Baselines for models of single images: the mean pose, image retrieval in the same features, and its oracle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lightning_pose.errors import ConfigError
from lightning_pose.features.retrieval import compute_global_vectors, find_nearest
from lightning_pose.geometry.quaternions import mean_quat, orientation_error_deg, position_error_m
from lightning_pose.metrics.summary import summarize_errors

__all__ = ["BaselineResult", "evaluate_baselines"]


@dataclass(frozen=True)
class BaselineResult:
    """A baseline's answer for every test frame.

    Attributes:
        position_m: (N_test, 3) float64.
        quat_wxyz: (N_test, 4) float64, unit.
        metrics: its summary, as `summarize_errors` names it.
    """

    position_m: Tensor
    quat_wxyz: Tensor
    metrics: dict[str, float]


def evaluate_baselines(
    train_features: Tensor | np.ndarray,
    train_position_m: Tensor | np.ndarray,
    train_quat_wxyz: Tensor | np.ndarray,
    test_features: Tensor | np.ndarray,
    test_position_m: Tensor | np.ndarray,
    test_quat_wxyz: Tensor | np.ndarray,
    seed: int = 0,
) -> dict[str, BaselineResult]:
    """Predict the test frames' poses without learning (Sattler et al., CVPR 2019).

    - `train_mean`: the mean of all training poses;
    - `retrieval_top1`: the pose of the training frame nearest in `compute_global_vectors`;
    - `retrieval_top5`: the mean pose of the five nearest (of all, where there are fewer);
    - `oracle`: the training pose nearest in position, a lower bound for the position errors of retrieval.

    Ties go to the earlier training frame, so a blank image, as far from all, gets the first.

    Args:
        train_features: (N_train, ...) in a layout of `compute_global_vectors`.
        train_position_m: (N_train, 3).
        train_quat_wxyz: (N_train, 4).
        test_features: (N_test, ...), the same layout.
        test_position_m: (N_test, 3).
        test_quat_wxyz: (N_test, 4).
        seed: of the k-means that local descriptors need.

    Raises:
        ConfigError: no training or no test frames, or features that `compute_global_vectors` refuses.
    """
    if not len(train_features) or not len(test_features):
        raise ConfigError(
            f"baselines need frames, but train has {len(train_features)} and test {len(test_features)}; "
            "check the scene's splits"
        )
    position, quat = _convert_poses(train_position_m, train_quat_wxyz)
    true_position, true_quat = _convert_poses(test_position_m, test_quat_wxyz)
    train_vectors, test_vectors = compute_global_vectors(train_features, test_features, seed)
    ranked = find_nearest(test_vectors, train_vectors, k=5)
    centre = position.mean(0)  # small numbers keep digits, where coordinates are geographic
    closest = find_nearest(true_position - centre, position - centre, k=1)
    chosen = {
        "train_mean": torch.arange(len(position))[None],
        "retrieval_top1": ranked[:, :1],
        "retrieval_top5": ranked,
        "oracle": closest,
    }
    results = {}
    for name, frames in chosen.items():
        position_hat = position[frames].mean(1).expand_as(true_position)
        quat_hat = mean_quat(quat[frames]).expand_as(true_quat)
        summary = summarize_errors(
            position_error_m(position_hat, true_position), orientation_error_deg(quat_hat, true_quat)
        )
        results[name] = BaselineResult(position_hat, quat_hat, summary)
    return results


def _convert_poses(position_m: Tensor | np.ndarray, quat_wxyz: Tensor | np.ndarray) -> tuple[Tensor, Tensor]:
    """The same poses as float64 tensors on the CPU."""
    position, quat = torch.as_tensor(position_m), torch.as_tensor(quat_wxyz)
    return position.detach().cpu().double(), quat.detach().cpu().double()
