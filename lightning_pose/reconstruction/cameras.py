"""The cameras of frames without poses: the user's, or one to be found for each size of image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pycolmap

from lightning_pose.geometry.camera import Camera
from lightning_pose.scenes.cameras import scale_camera
from lightning_pose.scenes.images import read_image_size

__all__ = ["list_cameras"]

FOCAL_SHARE = 0.9
"""Focal length that an unknown camera begins with, as a share of the longer side of the image: that of phones."""


def list_cameras(paths: Sequence[Path], camera: Camera | None) -> tuple[list[pycolmap.Camera], list[int]]:
    """The different cameras, and the row of that of each image.

    Args:
        paths: image files.
        camera: of all, scaled to the size of each; by default images of one size have one camera, whose focal length
            and radial distortion are to be found.

    Raises:
        ConfigError: the camera is for images of another shape.
        ImageError: an image cannot be read.
    """
    sizes = [read_image_size(path) for path in paths]
    different = list(dict.fromkeys(sizes))
    cameras = []
    for size in different:
        path = paths[sizes.index(size)]
        if camera is not None:
            cameras.append(_convert_camera(scale_camera(camera, *size, path, setting="--camera")))
        else:
            cameras.append(_guess_camera(path, size))
    return cameras, [different.index(size) for size in sizes]


def _convert_camera(camera: Camera) -> pycolmap.Camera:
    """A camera as COLMAP has it: pixels are counted from the corner of the first pixel."""
    shifted = replace(camera, cx=camera.cx + 0.5, cy=camera.cy + 0.5)
    model, width, height, *numbers = str(shifted).split(",")
    params = [float(number) for number in numbers]
    found = pycolmap.Camera(model=model, width=int(width), height=int(height), params=params)
    found.has_prior_focal_length = True
    return found


def _guess_camera(path: Path, size: tuple[int, int]) -> pycolmap.Camera:
    """A camera with the focal length of the image's EXIF data, or a usual one."""
    width, height = size
    found = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=width, height=height, params=[FOCAL_SHARE * max(size), width / 2, height / 2, 0]
    )
    try:
        inferred = pycolmap.infer_camera_from_image(path)
    except Exception:  # a kind of file that pycolmap does not read; OpenCV does
        return found
    if inferred.has_prior_focal_length and (inferred.width, inferred.height) == size:
        found.focal_length = inferred.mean_focal_length()
        found.has_prior_focal_length = True
    return found
