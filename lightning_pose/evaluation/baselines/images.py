"""What every model must beat: the mean pose, image retrieval in the same features, and its oracle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.quaternions import mean_quat, orientation_error_deg, position_error_m
from lightning_pose.metrics.summary import summarize_errors

__all__ = ["BaselineResult", "evaluate_baselines", "global_vectors", "nearest"]

VLAD_CENTRES = 64
VLAD_SAMPLE = 50_000
CHUNK = 256


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
    - `retrieval_top1`: the pose of the training frame nearest in `global_vectors`;
    - `retrieval_top5`: the mean pose of the five nearest (of all, where there are fewer);
    - `oracle`: the training pose nearest in position, which no retrieval can beat in that.

    Ties go to the earlier training frame, so a blank image, as far from all, gets the first.

    Args:
        train_features: (N_train, ...) in a layout of `global_vectors`.
        train_position_m: (N_train, 3).
        train_quat_wxyz: (N_train, 4).
        test_features: (N_test, ...), the same layout.
        test_position_m: (N_test, 3).
        test_quat_wxyz: (N_test, 4).
        seed: of the k-means that local descriptors need.

    Raises:
        ConfigError: no training or no test frames, or features that `global_vectors` refuses.
    """
    if not len(train_features) or not len(test_features):
        raise ConfigError(
            f"baselines need frames, but train has {len(train_features)} and test {len(test_features)}; "
            "check the scene's splits"
        )
    position, quat = _poses(train_position_m, train_quat_wxyz)
    true_position, true_quat = _poses(test_position_m, test_quat_wxyz)
    train_vectors, test_vectors = global_vectors(train_features, test_features, seed)
    ranked = nearest(test_vectors, train_vectors, k=5)
    centre = position.mean(0)  # small numbers keep digits, where coordinates are geographic
    closest = nearest(true_position - centre, position - centre, k=1)
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


def global_vectors(
    train_features: Tensor | np.ndarray, test_features: Tensor | np.ndarray, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """One L2-normalised vector per image, in which near means alike; a blank image's is zero.

    Args:
        train_features: (N, D) global vectors; (N, M, D) local descriptors, absent ones zero rows, which
            become VLAD vectors over centres learned on these alone; or (N, C, H, W) maps, mean-pooled.
        test_features: (N_test, ...), the same layout.
        seed: of the k-means.

    Returns:
        (N, D') and (N_test, D') float32.

    Raises:
        ConfigError: the layouts differ or are none of these.
    """
    train = torch.as_tensor(train_features).detach().cpu().float()
    test = torch.as_tensor(test_features).detach().cpu().float()
    if train.dim() not in (2, 3, 4) or train.shape[-1:] != test.shape[-1:] or train.dim() != test.dim():
        raise ConfigError(
            f"features are {tuple(train.shape)} in train and {tuple(test.shape)} in test; "
            "give both as (N, D), (N, M, D) or (N, C, H, W)"
        )
    if train.dim() == 3:
        centres = _vlad_centres(train, seed)
        return _vlad(train, centres), _vlad(test, centres)
    if train.dim() == 4:
        train, test = train.mean((2, 3)), test.mean((2, 3))
    return F.normalize(train, dim=-1), F.normalize(test, dim=-1)


def nearest(query: Tensor, reference: Tensor, k: int) -> Tensor:
    """(N_query, min(k, N_reference)) indices of the nearest reference rows, nearest first, ties in order."""
    rows = [torch.cdist(chunk, reference).sort(dim=1, stable=True).indices[:, :k] for chunk in query.split(CHUNK)]
    return torch.cat(rows)


def _poses(position_m: Tensor | np.ndarray, quat_wxyz: Tensor | np.ndarray) -> tuple[Tensor, Tensor]:
    position, quat = torch.as_tensor(position_m), torch.as_tensor(quat_wxyz)
    return position.detach().cpu().double(), quat.detach().cpu().double()


def _vlad_centres(descriptors: Tensor, seed: int) -> Tensor:
    """(K, D) k-means centres of a sample of (N, M, D) descriptors; K is smaller where these are few."""
    from sklearn.cluster import MiniBatchKMeans  # seconds to import, and only local descriptors need it

    rows = descriptors.flatten(0, 1)
    real = rows.any(dim=1).nonzero().squeeze(1)
    chosen = np.random.default_rng(seed).permutation(len(real))[:VLAD_SAMPLE]
    sample = np.unique(rows[real[chosen]].numpy(), axis=0)
    if not len(sample):
        return descriptors.new_zeros(1, descriptors.shape[-1])
    kmeans = MiniBatchKMeans(min(VLAD_CENTRES, len(sample)), batch_size=4096, random_state=seed)
    return torch.from_numpy(kmeans.fit(sample).cluster_centers_).float()


def _vlad(descriptors: Tensor, centres: Tensor) -> Tensor:
    """(N, K * D) VLAD vectors: per centre the sum of its descriptors' residuals (Jegou et al., CVPR 2010).

    Signed square roots tame bursts of one descriptor (Jegou et al., PAMI 2012); each centre's part is
    L2-normalised (Arandjelovic & Zisserman, CVPR 2013), then the whole.
    """
    K, D = centres.shape
    vectors = []
    for chunk in descriptors.split(CHUNK):
        image, row = chunk.any(dim=2).nonzero(as_tuple=True)
        real = chunk[image, row]
        centre = torch.cdist(real, centres).argmin(dim=1)
        residuals = chunk.new_zeros(len(chunk) * K, D).index_add_(0, image * K + centre, real - centres[centre])
        parts = F.normalize(residuals.sign() * residuals.abs().sqrt(), dim=-1)
        vectors.append(F.normalize(parts.view(len(chunk), K * D), dim=-1))
    return torch.cat(vectors)
