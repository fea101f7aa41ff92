"""Cameras as COLMAP's models and `transforms.json` write them, with pixels counted from the first pixel's corner."""

from __future__ import annotations

from collections.abc import Sequence

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.geometry.camera import Camera
from lightning_pose.scenes.scene import Intrinsics

__all__ = ["make_intrinsics"]


def make_intrinsics(where: str, model: str, width: int, height: int, parameters: Sequence[float]) -> Intrinsics:
    """The camera of one of COLMAP's models, with the first pixel's centre at (0, 0).

    Args:
        where: the file, for messages.
        model: one of `CAMERA_MODELS`.
        width: of the images that the parameters are for, in pixels.
        height: the same.
        parameters: in COLMAP's order; the principal point is counted from the corner of the first pixel.

    Raises:
        DataError: a number is impossible, or there are too many or too few.
    """
    try:
        camera = Camera.parse(",".join(map(str, (model, width, height, *map(float, parameters)))))
    except ConfigError as error:
        raise DataError(f"{where}: {error}; restore the original") from None
    return Intrinsics(
        camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5, (width, height), camera.distortion, camera.fisheye
    )
