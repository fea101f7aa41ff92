"""ErrorRadius: how far a regressor's poses may be off, and whether it refuses, by the distance to training images."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lightning_pose.mapping.calibration import find_conformal_factor

__all__ = ["ErrorRadius"]

DIMENSIONS = 128
"""Numbers of 16 bits that are kept of each training image: a file of 1000 images grows by 256 kB."""

MOST = 1000
"""Training images that are kept, evenly spaced."""

LIFTED = 256
"""Random projections of each descriptor, whose positive parts are added: plain sums do not tell noise from a room."""

CELLS = 8
"""Pixels of an image are averaged over so many rows and columns."""

LEAST_FRAMES = 10
"""Fewer validation frames say too little about how far images may be."""

BUFFERS = ("reference", "mean", "floor", "factors", "farthest")


class ErrorRadius(nn.Module):
    """Radii that hold 90 % of the errors of positions and orientations, by split conformal prediction.

    The radius of an image is a factor times (d + the median of d): d is its distance to the nearest training image in
    feature space, after a random projection. The factors are quantiles of error by (d + median) on validation frames
    (normalized conformal prediction: Papadopoulos, Gammerman, Vovk, 2008). They hold for further frames that are to the
    training frames as the validation frames are.

    An image is refused if d is more than `limit` times the largest d of a validation frame.

    Args:
        input_shape: of one frame's features.
        limit: see above; None refuses no image.
    """

    reference: Tensor
    mean: Tensor
    floor: Tensor
    factors: Tensor
    farthest: Tensor
    signs: Tensor
    lift: Tensor | None

    def __init__(self, input_shape: tuple[int, ...], limit: float | None = None) -> None:
        super().__init__()
        self.input_shape = input_shape
        self.limit = limit
        lift = _make_signs(input_shape[-1], LIFTED, seed=1) if len(input_shape) == 2 else None
        self.register_buffer("lift", lift, persistent=False)
        width = self._pool(torch.zeros(1, *input_shape)).shape[1]
        self.register_buffer("signs", _make_signs(width, DIMENSIONS), persistent=False)
        self.register_buffer("reference", torch.zeros(0, DIMENSIONS, dtype=torch.float16))
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("floor", torch.zeros(()))
        self.register_buffer("factors", torch.zeros(2))  # 0 is unknown
        self.register_buffer("farthest", torch.zeros(()))  # likewise
        self._scores: list[Tensor] = []
        self.register_load_state_dict_pre_hook(_fit_before_load)

    def set_training(self, features: Tensor) -> None:
        """Keep (M, *input_shape) features of training images, in few numbers each."""
        kept = torch.linspace(0, len(features) - 1, min(MOST, len(features))).round().long()
        pooled = torch.cat([self._pool(chunk) for chunk in features[kept].split(64)]).to(self.mean)
        self.mean = pooled.mean(0)
        self.reference = ((pooled - self.mean) @ self.signs).half()

    def measure_distance(self, features: Tensor) -> Tensor:
        """(B,) distances of (B, *input_shape) features to the nearest training image."""
        keys = (self._pool(features).to(self.mean) - self.mean) @ self.signs
        return torch.cdist(keys.float(), self.reference.float()).amin(1)

    def add_errors(self, features: Tensor, position_error: Tensor, orientation_error_deg: Tensor) -> None:
        """Add a validation batch, (B,) errors each."""
        errors = torch.stack([position_error, orientation_error_deg], dim=1)
        self._scores.append(torch.cat([self.measure_distance(features)[:, None], errors.float()], dim=1).detach())

    def take_scores(self) -> Tensor:
        """(N, 3) distances and errors that were added; they are dropped."""
        scores, self._scores = torch.cat([self.mean.new_zeros(0, 3), *self._scores]), []
        return scores

    def calibrate(self, scores: Tensor) -> None:
        """Find the factors and the farthest frame from (N, 3) distances and errors; unknown if there are too few."""
        if not len(scores):
            return
        distance, *errors = scores.double().cpu().T
        self.floor.fill_(float(distance.median()))
        scale = (distance + distance.median()).clamp(min=1e-9).numpy()
        factors = [find_conformal_factor(error.numpy() / scale) for error in errors]
        self.factors.copy_(torch.tensor(factors).nan_to_num(0.0))
        self.farthest.fill_(float(distance.max()) if len(distance) >= LEAST_FRAMES else 0.0)

    def find_radii(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """(B,) radii in the scene's unit and in degrees; nan where they are unknown."""
        if not len(self.reference):
            unknown = torch.full((len(features),), torch.nan)
            return unknown, unknown
        scale = (self.measure_distance(features) + self.floor).double().cpu()
        position, orientation = (factor or np.nan for factor in self.factors.tolist())
        return scale * position, scale * orientation

    @property
    def has_limit(self) -> bool:
        """Whether images can be too far: a limit is set, and the farthest validation frame is known."""
        return bool(self.limit and self.farthest > 0)

    def measure_excess(self, features: Tensor) -> Tensor:
        """(B,) distances by the largest that is accepted, so that above 1 is refused; nan where that is unknown."""
        if not self.has_limit or self.limit is None:
            return torch.full((len(features),), torch.nan)
        return (self.measure_distance(features) / (self.limit * self.farthest)).cpu()

    def resize(self, state_dict: dict[str, Tensor]) -> None:
        """Make room for the training images of a state dict; older versions kept fewer numbers, of plain sums."""
        reference, mean = state_dict.get("reference"), state_dict.get("mean")
        if mean is not None and mean.ndim == 1 and len(self.input_shape) == 2:
            plain = len(mean) == self.input_shape[1]
            self.lift = None if plain else _make_signs(self.input_shape[1], LIFTED, seed=1).to(self.mean)
            self.mean = self.mean.new_zeros(len(mean))
        if reference is not None and reference.ndim == 2:
            self.reference = torch.zeros_like(reference, device=self.mean.device)
            self.signs = _make_signs(len(self.mean), reference.shape[1]).to(self.mean)

    def _pool(self, features: Tensor) -> Tensor:
        """(B, D) unit vectors of features (B, D), of keypoints (B, N, D), of maps or of images (B, C, H, W)."""
        features = features.float()
        if features.ndim == 3:
            features = features.sum(1) if self.lift is None else (features @ self.lift.to(features)).relu().sum(1)
        elif features.ndim == 4:
            small = features.shape[1] <= 4
            features = F.adaptive_avg_pool2d(features, CELLS if small else 1).flatten(1)
        return F.normalize(features, dim=1)


def _make_signs(width: int, dimensions: int, seed: int = 0) -> Tensor:
    """(width, dimensions), a random projection that keeps distances, the same for ever."""
    bits = np.random.PCG64(seed).random_raw(-(-width * dimensions // 64)).view(np.uint8)
    signs = np.unpackbits(bits)[: width * dimensions].reshape(width, dimensions).astype(np.float32) * 2 - 1
    return torch.from_numpy(signs / np.float32(dimensions**0.5))


def _fit_before_load(module: nn.Module, state_dict: dict[str, Tensor], prefix: str, *_: object) -> None:
    """Make room for a checkpoint's training images; an older checkpoint has none, so that radii are unknown."""
    assert isinstance(module, ErrorRadius)
    for name in BUFFERS:
        empty = getattr(module, name)
        state_dict.setdefault(f"{prefix}{name}", empty[:0] if name == "reference" else empty)
    module.resize({name.removeprefix(prefix): value for name, value in state_dict.items() if name.startswith(prefix)})
