"""The images themselves, in one size: input of networks that are trained from end to end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import cv2
import numpy as np
from torch import Tensor
from torch.nn import functional as F

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.features.base import FeatureExtractor, Record

__all__ = ["Pixels"]

_TINY = 32  # side of the images that retrieval compares


class Pixels(FeatureExtractor):
    """RGB images, (3, height, width) uint8: resized until they cover that size, then cropped to their middle.

    The default keeps the whole of an image of 4:3, with the shorter side of 256 pixels that networks have in ImageNet's
    tests. A record holds `pixels`. Image retrieval compares gray thumbnails of 32 x 32 without their mean
    (Torralba et al., PAMI 2008).

    Args:
        height: of the resized images, in pixels.
        width: likewise.

    Raises:
        ConfigError: height or width is not positive.
    """

    color: ClassVar[Literal["gray", "rgb"]] = "rgb"
    primary: ClassVar[str] = "pixels"
    dtype: ClassVar[type[np.generic]] = np.uint8

    def __init__(self, height: int = 256, width: int = 341) -> None:
        if height < 1 or width < 1:
            raise ConfigError(f"height is {height} and width is {width}; give pixels, such as 256 and 341")
        self.height = height
        self.width = width

    @property
    def settings(self) -> Mapping[str, str | int | float | bool | None]:
        return {"height": self.height, "width": self.width}

    @property
    def feature_shape(self) -> tuple[int, ...]:
        return 3, self.height, self.width

    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        """One record for each (H, W, 3) uint8 RGB image.

        Raises:
            ImageError: an image is not such an array, or has no pixels.
        """
        for i, image in enumerate(images):
            if image.ndim != 3 or image.shape[2] != 3 or image.size == 0 or image.dtype != np.uint8:
                raise ImageError(f"image {i} has shape {image.shape} and type {image.dtype}; give (H, W, 3) uint8 RGB")
        return [{"pixels": np.ascontiguousarray(self._fit(image).transpose(2, 0, 1))} for image in images]

    def appearance(self, features: Tensor) -> Tensor:
        gray = features.float().mean(1, keepdim=True)
        tiny = F.adaptive_avg_pool2d(gray, _TINY).flatten(1)
        return tiny - tiny.mean(1, keepdim=True)

    def mirror(self, features: Tensor) -> Tensor:
        return features.flip(-1)

    def _fit(self, image: np.ndarray) -> np.ndarray:
        """Resize and crop an image (H, W, 3) to (height, width, 3)."""
        rows, columns = image.shape[:2]
        scale = max(self.height / rows, self.width / columns)
        size = max(self.width, round(columns * scale)), max(self.height, round(rows * scale))
        resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        top, left = (size[1] - self.height) // 2, (size[0] - self.width) // 2
        return resized[top : top + self.height, left : left + self.width]
