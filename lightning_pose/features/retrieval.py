"""Image retrieval: one vector per image, and the nearest vectors."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from lightning_pose.errors import ConfigError

__all__ = ["compute_global_vectors", "find_nearest"]

VLAD_CENTRES = 64

VLAD_SAMPLE = 50_000
"""Descriptors that the centres are computed from."""

CHUNK = 256
"""Images whose distances or vectors are computed at once, to limit memory."""


def compute_global_vectors(
    train_features: Tensor | np.ndarray, test_features: Tensor | np.ndarray, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Compute one L2-normalised vector per image; similar images have near vectors, an image without features zero.

    Args:
        train_features: (N, D) global vectors; (N, M, D) local descriptors, absent ones zero rows, which
            become VLAD vectors with centres from the training images alone; or (N, C, H, W) maps, mean-pooled.
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
        centres = _learn_vlad_centres(train, seed)
        return _compute_vlad(train, centres), _compute_vlad(test, centres)
    if train.dim() == 4:
        train, test = train.mean((2, 3)), test.mean((2, 3))
    return F.normalize(train, dim=-1), F.normalize(test, dim=-1)


def find_nearest(query: Tensor, reference: Tensor, k: int) -> Tensor:
    """Indices (N_query, min(k, N_reference)) of the nearest reference rows, by distance, then by row."""
    rows = [torch.cdist(chunk, reference).sort(dim=1, stable=True).indices[:, :k] for chunk in query.split(CHUNK)]
    return torch.cat(rows)


def _learn_vlad_centres(descriptors: Tensor, seed: int) -> Tensor:
    """K-means centres (K, D) of a sample of descriptors (N, M, D); K is VLAD_CENTRES, or less if there are fewer."""
    from sklearn.cluster import MiniBatchKMeans  # takes seconds to import, and only local descriptors need it

    rows = descriptors.flatten(0, 1)
    real = rows.any(dim=1).nonzero().squeeze(1)
    chosen = np.random.default_rng(seed).permutation(len(real))[:VLAD_SAMPLE]
    sample = np.unique(rows[real[chosen]].numpy(), axis=0)
    if not len(sample):
        return descriptors.new_zeros(1, descriptors.shape[-1])
    kmeans = MiniBatchKMeans(min(VLAD_CENTRES, len(sample)), batch_size=4096, random_state=seed)
    return torch.from_numpy(kmeans.fit(sample).cluster_centers_).float()


def _compute_vlad(descriptors: Tensor, centres: Tensor) -> Tensor:
    """VLAD vectors (N, K * D): for each centre the sum of its descriptors' residuals (Jegou et al., CVPR 2010).

    Signed square roots reduce the weight of repeated descriptors (Jegou et al., PAMI 2012); each centre's part is
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
