"""KernelPoseNet: LinearPoseNet's closed form on a Gaussian kernel between images."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lightning_pose.data.datamodule import scene_datamodule
from lightning_pose.errors import ConfigError
from lightning_pose.models.closed_form import ClosedFormModule, LinearNetwork
from lightning_pose.models.parts.memory import TrainingMemory
from lightning_pose.models.parts.ridge import Ridge

__all__ = ["KernelPoseNet"]


class KernelPoseNet(TrainingMemory, ClosedFormModule):
    """Kernel ridge regression from (D,) features to the pose (Saunders et al., ICML 1998), without gradients.

    The kernel between two images is exp(-gamma d^2 / m): d is the distance between their features, m the median of
    d^2 between landmarks. With all training frames as landmarks, validation frames included where `refit` learns
    from them, this is kernel ridge regression itself; with fewer its Nystroem approximation (Williams & Seeger, NIPS
    2000), in one streaming pass as for LinearPoseNet. The checkpoint carries the landmarks' features.

    It is not in the thesis. As gamma goes to 0 it becomes the thesis's LinearPoseNet.

    Args:
        lambdas: ridge strengths to choose from; 1 is as strong as one frame.
        gamma: how fast the kernel falls with distance: at the median distance it is exp(-gamma).
        landmarks: how many frames to keep at most, evenly spaced.
        normalize: measure distances between features of unit length, as image retrieval does.
        **kwargs: what `ClosedFormModule` takes.

    Raises:
        ConfigError: a number is not positive, or as for `ClosedFormModule`.
    """

    memory: ClassVar[tuple[str, ...]] = ("network.landmarks", "network.weight")
    network: _KernelMachine

    def __init__(
        self,
        lambdas: list[float] = [3e-3],  # noqa: B006  (never changed; shown as it is in --help)
        gamma: float = 0.2,
        landmarks: int = 2000,
        normalize: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(lambdas=lambdas, **kwargs)
        if not gamma > 0 or landmarks < 1:
            raise ConfigError(f"gamma is {gamma} and landmarks is {landmarks}; give above 0, such as 0.2 and 2000")
        self.gamma = gamma
        self.landmarks = landmarks
        self.network = _KernelMachine(self.input_shape[0], normalize)

    @property
    def headline(self) -> str:
        return f"D={self.input_shape[0]} gamma={self.gamma:g}"

    def setup(self, stage: str) -> None:
        super().setup(stage)
        if stage == "fit":
            datamodule = scene_datamodule(self.trainer)
            features = torch.cat([datamodule.dataset(split).data.features for split in self.training_splits])
            kept = torch.linspace(0, len(features) - 1, min(self.landmarks, len(features))).round().long()
            self.network.set_landmarks(self.standardize_input(features[kept].to(self.device)), self.gamma)


LEAST_DIAGONAL = 1e-9
"""Added to each landmark's kernel with itself, which is 1."""


class _KernelMachine(LinearNetwork):
    """Seven numbers, linear in an image's kernels with M landmarks.

    In double precision throughout: solutions cancel large numbers.
    """

    products_in: ClassVar[torch.dtype] = torch.float64
    landmarks: Tensor
    scale: Tensor
    bias: Tensor

    def __init__(self, n_columns: int, normalize: bool) -> None:
        super().__init__()
        self.normalize = normalize
        self.weight = nn.Parameter(torch.zeros(0, 7, dtype=torch.float64))
        self.register_buffer("landmarks", torch.zeros(0, n_columns))
        self.register_buffer("scale", torch.ones((), dtype=torch.float64))
        self.register_buffer("bias", torch.zeros(7, dtype=torch.float64))
        self._factor = torch.zeros(0, 0)  # (M, M), lower triangle: times its transpose it is the landmarks' kernels

    @property
    def n_lifted(self) -> int:
        return len(self._factor)

    def set_landmarks(self, landmarks: Tensor, gamma: float) -> None:
        """Keep (M, D) landmarks, measure their spread, and factorise their kernels for `lift`."""
        self.landmarks = self._to_keys(landmarks)
        self.weight.data = self.weight.new_zeros(len(landmarks), 7)
        squared = _square_distances(self.landmarks, self.landmarks)
        step = -(-len(landmarks) // 1000)
        sample = squared[::step, ::step]
        rows, columns = torch.triu_indices(*sample.shape, offset=1)
        spread = float(sample[rows, columns].median()) if len(rows) else 1.0
        self.scale.fill_(gamma / spread if spread > 0 else gamma)
        self._factor = _factorise(torch.exp(-self.scale * squared))

    def lift(self, features: Tensor) -> Tensor:
        """(B, D) -> (B, M), whose products with each other are the images' kernels."""
        return torch.linalg.solve_triangular(self._factor, self._kernel(self._to_keys(features)).T, upper=False).T

    def set_solution(self, solution: Ridge) -> None:
        self.weight.copy_(torch.linalg.solve_triangular(self._factor.T, solution.weight.T, upper=True))
        self.bias.copy_(solution.bias)

    def forward(self, features: Tensor) -> Tensor:
        return (self._kernel(self._to_keys(features)) @ self.weight + self.bias).to(features.dtype)

    def _to_keys(self, features: Tensor) -> Tensor:
        """What distances are measured between, (B, D)."""
        return F.normalize(features, dim=-1) if self.normalize else features

    def _kernel(self, keys: Tensor) -> Tensor:
        """(B, D) -> (B, M)."""
        return torch.exp(-self.scale * _square_distances(keys, self.landmarks))


def _square_distances(a: Tensor, b: Tensor) -> Tensor:
    """Squared distances (B, M) between (B, D) and (M, D), in double precision."""
    ours, theirs = a.double(), b.double()
    squared = ours.square().sum(1, keepdim=True) + theirs.square().sum(1)
    return squared.addmm_(ours, theirs.T, alpha=-2).clamp_(min=0)


def _factorise(kernels: Tensor) -> Tensor:
    """Cholesky's factor of (M, M) kernels, with little on the diagonal, and more where rounding asks for it.

    Equal landmarks make equal rows. What is added acts as so much more ridge.
    """
    one = torch.eye(len(kernels)).to(kernels)
    for diagonal in (LEAST_DIAGONAL, 10 * LEAST_DIAGONAL, 100 * LEAST_DIAGONAL):
        factor, failed = torch.linalg.cholesky_ex(kernels + diagonal * one)
        if not failed:
            return factor
    return torch.linalg.cholesky(kernels + 1000 * LEAST_DIAGONAL * one)
