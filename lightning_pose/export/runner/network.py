"""The network of an exported folder: `model.onnx`, asked by onnxruntime with one image or one clip."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lightning_pose.errors import CheckpointError, ConfigError

__all__ = ["Network", "NetworkAnswer", "fit_pixels"]


@dataclass(frozen=True)
class NetworkAnswer:
    """Position (3,) float64, quaternion (4,) of unit length, radii that hold 90 % of errors, and the distance to the
    training images by the largest that is accepted; nan if unknown."""

    position_m: np.ndarray
    quat_wxyz: np.ndarray
    radius_m: float
    radius_deg: float
    excess: float


class Network:
    """An onnxruntime session; threads may share it.

    Args:
        path: of the ONNX file.

    Raises:
        ConfigError: onnxruntime is not installed.
        CheckpointError: the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime  # not needed, and not imported, where a folder holds a map alone
        except ImportError as error:
            raise ConfigError("this model needs onnxruntime; run `pip install onnxruntime`") from error
        options = onnxruntime.SessionOptions()
        threads = os.environ.get("OMP_NUM_THREADS", "")
        if threads.isdigit():
            options.intra_op_num_threads = int(threads)
        options.log_severity_level = 3
        try:
            self.session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises kinds of its own, which are not public
            raise CheckpointError(f"{path} cannot be read ({error}); export the model again") from error
        self.input = self.session.get_inputs()[0].name

    def locate(self, image: np.ndarray) -> NetworkAnswer:
        """The answer for (H, W, 3) uint8 pixels, or for what `features` of the folder's `localizer.json` names."""
        position_m, quat_wxyz, *certainty = map(np.asarray, self.session.run(None, {self.input: image}))
        radius_m, radius_deg, *excess = (float(value[0]) for value in certainty)  # folders of version 1 have no third
        return NetworkAnswer(
            position_m[0], quat_wxyz[0].astype(np.float64), radius_m, radius_deg, *excess or [math.nan]
        )

    def locate_clip(self, clip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (T, 3) and quaternions (T, 4), float64, of a clip (1, T, ...)."""
        position_m, quat_wxyz = map(np.asarray, self.session.run(None, {self.input: clip}))
        return position_m, quat_wxyz.astype(np.float64)


def fit_pixels(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """(3, height, width): an image (H, W, 3) resized until it covers that size, then cropped to its middle."""
    rows, columns = image.shape[:2]
    scale = max(height / rows, width / columns)
    size = max(width, round(columns * scale)), max(height, round(rows * scale))
    resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    top, left = (size[1] - height) // 2, (size[0] - width) // 2
    return np.ascontiguousarray(resized[top : top + height, left : left + width].transpose(2, 0, 1))
