"""Images of other sizes than those of a map: enlarged until a pixel is as small an angle."""

from __future__ import annotations

import cv2
import numpy as np

from lightning_pose.geometry.camera import Camera
from lightning_pose.scenes.cameras import scale_camera

__all__ = ["enlarge_image"]

MIN_ENLARGEMENT, MAX_ENLARGEMENT = 1.2, 4.0
"""By how much images are enlarged at least, and at most."""

MAX_ENLARGED_PIXELS = 25_000_000
"""Of an enlarged image: the camera may come from a stranger, and one of a tiny focal length would fill the memory."""


def enlarge_image(array: np.ndarray, view: Camera, camera: Camera) -> np.ndarray:
    """The image with pixels as small an angle as in a map's images; the same array where they are not larger.

    Keypoints of small images are too few and too uncertain for a map of larger ones: in images of half the size they
    locate three times worse, and in the same images enlarged as well as in the large ones.

    Args:
        array: (H, W) or (H, W, 3).
        view: the camera of the map's images.
        camera: of this image, for any size of the same shape.

    Raises:
        ConfigError: the image has another shape than those that the camera is for.
    """
    factor = view.focal_px / scale_camera(camera, array.shape[1], array.shape[0], setting="camera").focal_px
    factor = min(factor, MAX_ENLARGEMENT, (MAX_ENLARGED_PIXELS / (array.shape[0] * array.shape[1])) ** 0.5)
    if factor < MIN_ENLARGEMENT:
        return array
    size = round(array.shape[1] * factor), round(array.shape[0] * factor)
    return cv2.resize(array, size, interpolation=cv2.INTER_CUBIC)
