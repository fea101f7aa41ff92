"""PoseNet: a pretrained CNN fine-tuned from end to end, with which cheaper systems are compared."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from lightning_pose.data.batches import PoseBatch
from lightning_pose.errors import ConfigError
from lightning_pose.features.backbones import BACKBONES, build_backbone
from lightning_pose.models.base import PoseModule

__all__ = ["PoseNet"]


class PoseNet(PoseModule):
    """A CNN, a fully connected layer and the pose, all trained (Kendall et al., ICCV 2015), from (3, H, W) images.

    In training each image is cropped at a random place, otherwise in the middle. The learned balance of position and
    orientation of Kendall & Cipolla (CVPR 2017) is `loss: {form: split, learned_weights: true}`, the fixed one
    `orientation_weight`. `trainer.precision: 16-mixed` halves time and memory on a GPU, and `bf16-mixed` on CPUs
    that have bfloat16; poses and loss stay in single precision.

    The pretrained weights are read when training starts; a checkpoint does not need them.

    Args:
        backbone: a CNN, as for `lightning_pose.features.backbones.build_backbone`.
        weights: `imagenet`, `places365`, `none` or the path of a checkpoint, likewise.
        crop: side of the square that is cut out of each image, in pixels.
        units: width of the fully connected layer.
        dropout: after it.
        **kwargs: what `PoseModule` takes.

    Raises:
        ConfigError: a number is out of its range, the images are no RGB or smaller than the crop, or the crop is too
            small for the backbone.
        CheckpointError: when training starts, the weights cannot be downloaded or read.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (3,)
    network: _FineTuned

    def __init__(
        self,
        backbone: str = "efficientnet_lite0",
        weights: str = "imagenet",
        crop: int = 224,
        units: int = 2048,
        dropout: float = 0.5,
        standardize_features: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(standardize_features=standardize_features, **kwargs)
        channels, height, width = self.input_shape
        if channels != 3:
            raise ConfigError(
                f"PoseNet reads RGB images, not {channels} channels; "
                "give lightning_pose.features.Pixels as data.extractor"
            )
        if not 1 <= crop <= min(height, width):
            raise ConfigError(f"crop is {crop} and images are {height} x {width}; give 1 to {min(height, width)}")
        if units < 1 or not 0 <= dropout < 1:
            raise ConfigError(f"units is {units} and dropout {dropout}; give 1 or more, and 0 to below 1")
        self.backbone = backbone
        self.weights = weights
        self.crop = crop
        cnn = build_backbone(backbone, "none" if backbone in BACKBONES else "imagenet")
        self.network = _FineTuned(cnn.train().requires_grad_(True), _measure_width(cnn, backbone, crop), units, dropout)

    @property
    def headline(self) -> str:
        return f"{self.backbone.rpartition('.')[2]} {self.crop}"

    def setup(self, stage: str) -> None:
        super().setup(stage)
        if stage == "fit":
            self.network.cnn.load_state_dict(build_backbone(self.backbone, self.weights).state_dict())

    def decode_features(self, features: Tensor) -> tuple[Tensor, Tensor]:
        top, left = ((size - self.crop) // 2 for size in features.shape[-2:])
        return super().decode_features(features[..., top : top + self.crop, left : left + self.crop])

    def decode_batch(self, batch: PoseBatch) -> tuple[Tensor, Tensor]:
        if not self.training:
            return self.decode_features(batch.features)
        return super().decode_features(_crop_at_random(batch.features, self.crop))


class _FineTuned(nn.Module):
    """A CNN with pooled output, and two linear layers."""

    def __init__(self, cnn: nn.Module, width: int, units: int, dropout: float) -> None:
        super().__init__()
        # The layout that convolutions prefer: 0.6 of the time of a step of EfficientNet-Lite0 on a CPU.
        self.cnn = cnn.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.head = nn.Sequential(nn.Linear(width, units), nn.ReLU(), nn.Dropout(dropout), nn.Linear(units, 7))

    def forward(self, pixels: Tensor) -> Tensor:
        """(B, 3, h, w) RGB in 0..255 -> (B, 7)."""
        vector = _pool_cells(self.cnn((pixels.float() / 255).contiguous(memory_format=torch.channels_last)))
        with torch.autocast(pixels.device.type, enabled=False):  # half precision would round poses to centimetres
            return self.head(vector.float())


def _pool_cells(out: Tensor) -> Tensor:
    """(B, C, h, w) or (B, C) -> (B, C)."""
    return out.mean((2, 3)) if out.ndim == 4 else out


def _crop_at_random(images: Tensor, side: int) -> Tensor:
    """(B, 3, side, side): a square of each (3, H, W) image, each at its own random place."""
    rows, columns = (torch.randint(size - side + 1, (len(images),)).tolist() for size in images.shape[-2:])
    cut = zip(images, rows, columns, strict=True)
    return torch.stack([image[:, top : top + side, left : left + side] for image, top, left in cut])


@torch.no_grad()
def _measure_width(cnn: nn.Module, backbone: str, crop: int) -> int:
    """How many columns the CNN's pooled output has."""
    training = cnn.training
    try:
        out = _pool_cells(cnn.eval()(torch.zeros(1, 3, crop, crop)))
    except RuntimeError as error:
        raise ConfigError(
            f"{backbone} cannot take a crop of {crop} ({error}); give a larger one, such as 224"
        ) from error
    finally:
        cnn.train(training)
    if out.ndim != 2 or out.isnan().any():
        raise ConfigError(
            f"{backbone} returned {tuple(out.shape)} for one crop of {crop}; its forward must return (B, C) or "
            "(B, C, h, w), with a larger crop if there are no cells"
        )
    return out.shape[1]
