"""Features of frozen pretrained CNNs: one pooled vector per image, or the map before pooling."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal, get_args

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils import convert_conv2d_weight_memory_format

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.features.backbones import BACKBONES, Backbone, build_backbone, check_backbone
from lightning_pose.features.base import FeatureExtractor, Record

__all__ = ["CNN"]

CPU_BATCH = 2
"""Images at a time on a CPU. Eight take half as long again with EfficientNet-Lite0: its first arrays of so many are too
large for the C library to keep, and the system clears fresh memory for each."""

Output = Literal["vector", "map"]
Crop = Literal["center", "whole"]

_RESIZE = 256 / 224  # shorter side of the resized image by side of the crop, in the ImageNet tests of all these CNNs
_LOADING = threading.Lock()  # not an attribute, so that an extractor can be copied and pickled


class CNN(FeatureExtractor):
    """A frozen CNN's last feature map (C, h, w), or its mean over all cells, (C,).

    A record holds `features`: float32 for a vector, float16 for a map, which is large (ResNet50's 7 x 7 x 2048
    are 200 kB). The network is loaded by the first call of `extract` and runs on the GPU if there is one, in
    half precision.

    Args:
        backbone: a name of `lightning_pose.features.backbones.BACKBONES`, or the class path of any
            `torch.nn.Module` that fulfils what `build_backbone` asks of it.
        weights: `imagenet`, `places365`, `none` or the path of a checkpoint, as for `build_backbone`.
        output: `vector` or `map`.
        size: side of the square image that the network gets; by default that of its training images
            (224; 299 for inception_v3).
        crop: `center` resizes the shorter side to 256/224 of the square and cuts out the middle, as in the networks'
            ImageNet tests; `whole` resizes the whole frame to the square, whatever its aspect ratio, so that no part
            is lost.

    Raises:
        ConfigError: an unknown backbone, output or crop, or a size too small for the network.
        CheckpointError: weights is a path, and there is no such file; or, on first use, the weights cannot be
            downloaded or read.
    """

    color: ClassVar[Literal["gray", "rgb"]] = "rgb"
    primary: ClassVar[str] = "features"

    def __init__(
        self,
        backbone: str = "efficientnet_lite0",
        weights: str = "imagenet",
        output: Output = "vector",
        size: int | None = None,
        crop: Crop = "center",
    ) -> None:
        check_backbone(backbone, weights)
        for name, value, known in (("output", output, get_args(Output)), ("crop", crop, get_args(Crop))):
            if value not in known:
                raise ConfigError(f"{name} is {value!r}; give one of {', '.join(known)}")
        if size is not None and size < 1:
            raise ConfigError(f"size is {size}; give the side of the network's image in pixels, such as 224")
        self.backbone = backbone
        self.weights = weights
        self.output: Output = output
        self.size = size
        self.crop: Crop = crop
        self._loaded: nn.Module | None = None

    @property
    def name(self) -> str:
        """The backbone's name, or its class's in lower case."""
        return self.backbone.rpartition(".")[2].lower()

    @cached_property
    def settings(self) -> Mapping[str, str | int | float | bool | None]:
        """The arguments; weights of the user's own are replaced by a digest, so that a moved file is still cached.

        The precision is added, because a GPU computes in half precision, and its features differ from a CPU's.
        """
        if self.backbone not in BACKBONES:
            weights = _hash_weights(self._network)
        elif Path(self.weights).is_file():
            weights = hashlib.blake2b(Path(self.weights).read_bytes(), digest_size=8).hexdigest()
        else:
            weights = self.weights
        return {
            "backbone": self.backbone,
            "weights": weights,
            "output": self.output,
            "size": self.side,
            "crop": self.crop,
            "precision": "float16" if _choose_device().type == "cuda" else "float32",
        }

    @cached_property
    def feature_shape(self) -> tuple[int, ...]:
        """(C,) or (C, h, w); of a backbone in `BACKBONES` it is computed without reading weights.

        Raises:
            ConfigError: the size is too small for the network, or the network returns another shape than
                `build_backbone` asks for.
        """
        if self.backbone in BACKBONES:
            network, device = Backbone(self.backbone).eval(), torch.device("cpu")
        else:
            network, device = self._network, _choose_device()
        rgb = torch.zeros(1, 3, self.side, self.side, device=device)
        try:
            shape = tuple(self._run(network, rgb).shape[1:])
        except RuntimeError as error:
            raise ConfigError(
                f"{self.backbone} cannot take images of size {self.side} ({error}); give a larger size, such as 224"
            ) from error
        if len(shape) != (3 if self.output == "map" else 1) or 0 in shape:
            raise ConfigError(
                f"{self.backbone} returned {shape} for each image, but output is {self.output}; its forward must "
                "return (B, C) or (B, C, h, w), and its feature_map, where it has one, (B, C, h, w)"
            )
        return shape

    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        """One record for each (H, W, 3) uint8 RGB image.

        Raises:
            ImageError: an image is not such an array, or has no pixels.
            ConfigError: as `feature_shape`.
            CheckpointError: the weights cannot be downloaded or read.
        """
        for i, image in enumerate(images):
            if image.ndim != 3 or image.shape[2] != 3 or image.size == 0 or image.dtype != np.uint8:
                raise ImageError(f"image {i} has shape {image.shape} and type {image.dtype}; give (H, W, 3) uint8 RGB")
        if not images:
            return []
        _ = self.feature_shape  # raises an error if size or network do not work
        rgb = torch.stack([self._prepare(image) for image in images])
        rgb = rgb.to(_choose_device(), memory_format=torch.channels_last)
        stored = torch.float16 if self.output == "map" else torch.float32
        parts = rgb.split(len(rgb) if rgb.is_cuda else CPU_BATCH)
        rows = torch.cat([self._run(self._network, part).to("cpu", stored) for part in parts])
        return [{"features": row.numpy()} for row in rows]

    def features(self, record: Record) -> np.ndarray:
        return record["features"].astype(np.float32)

    def load_network(self) -> nn.Module:
        """The CNN with its weights, in evaluation mode: (B, 3, side, side) RGB in 0..1 to a vector or a map.

        Raises:
            CheckpointError: the weights cannot be downloaded or read.
        """
        return self._network

    @property
    def side(self) -> int:
        """Side of the square image that the network gets, in pixels."""
        return self.size or BACKBONES.get(self.backbone, BACKBONES["resnet50"]).size

    @property
    def short_side(self) -> int:
        """Shorter side of the resized image before `center` cuts the square out of it, in pixels."""
        return round(self.side * _RESIZE)

    @property
    def _network(self) -> nn.Module:
        """The CNN, which is built by the first call."""
        with _LOADING:  # the cache extracts with several threads
            if self._loaded is None:
                network = build_backbone(self.backbone, self.weights).eval().requires_grad_(False).to(_choose_device())
                # In this layout convolutions are faster: a sixth less time for EfficientNet-Lite0 on a CPU.
                self._loaded = convert_conv2d_weight_memory_format(network, torch.channels_last)
            return self._loaded

    def _prepare(self, image: np.ndarray) -> Tensor:
        """(H, W, 3) uint8 -> (3, side, side) in 0..1."""
        side = self.side
        height, width = image.shape[:2]
        rgb = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
        if self.crop == "whole":
            return _resize_images(rgb, side, side)[0]
        scale = self.short_side / min(height, width)
        rgb = _resize_images(rgb, round(height * scale), round(width * scale))
        top, left = (rgb.shape[2] - side) // 2, (rgb.shape[3] - side) // 2
        return rgb[0, :, top : top + side, left : left + side]

    @torch.inference_mode()
    def _run(self, network: nn.Module, rgb: Tensor) -> Tensor:
        """(B, C) or (B, C, h, w) of (B, 3, H, W)."""
        with torch.autocast("cuda", torch.float16, enabled=rgb.is_cuda):
            out = getattr(network, "feature_map", network)(rgb) if self.output == "map" else network(rgb)
        return out.float().mean((2, 3)) if self.output == "vector" and out.ndim == 4 else out


def _resize_images(rgb: Tensor, height: int, width: int) -> Tensor:
    """Resize images (B, 3, H, W) by bilinear interpolation with antialiasing."""
    return F.interpolate(rgb, (height, width), mode="bilinear", antialias=True)


def _choose_device() -> torch.device:
    """The GPU if there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _hash_weights(network: nn.Module) -> str:
    """Digest of the names and values of all parameters and buffers."""
    digest = hashlib.blake2b(digest_size=8)
    for name, value in network.state_dict().items():
        digest.update(name.encode() + value.cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
