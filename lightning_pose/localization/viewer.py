"""Recordings for the rerun viewer: a map's points, and each image with its camera, inliers and radius."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.camera import Camera
from lightning_pose.localization.located_pose import LocatedPose
from lightning_pose.scenes.cameras import has_shape

__all__ = ["ViewRecorder"]

LONGEST_PX, JPEG_QUALITY = 640, 80
"""Images in a recording are shrunk to this, because they are most of it."""

GRAY, BLUE, GREEN = (150, 150, 150), (0, 114, 178), (0, 158, 115)

FIELD_OF_VIEW = math.radians(60)
"""Across, of cameras that nobody knows; only the drawing depends on it."""


class ViewRecorder:
    """Writes a `.rrd` file, frame by frame.

    Args:
        path: the file to write.
        points: (P, 3) of the map, in the world; None without a map.
        camera: of the images, or None.

    Raises:
        ConfigError: rerun is not installed, or the file cannot be written.
    """

    def __init__(self, path: str | Path, points: np.ndarray | None, camera: Camera | None) -> None:
        try:
            import rerun
        except ImportError as error:
            raise ConfigError(
                "--view needs rerun, which is not installed; `uv sync --extra view`, or `pip install rerun-sdk`"
            ) from error
        self._rerun = rerun
        self._camera = camera
        self._count = 0
        self._trajectory: list[np.ndarray] = []
        self._stream = rerun.RecordingStream("lightning_pose localize")
        try:
            self._stream.save(str(path))
        except Exception as error:  # rerun's own errors are of no public type
            raise ConfigError(f"{path} cannot be written ({error}); choose another file") from error
        if points is not None:
            self._stream.log("world/map", rerun.Points3D(points, colors=GRAY), static=True)

    def add(self, pose: LocatedPose, pixels: np.ndarray | None) -> None:
        """Add an image, (H, W) or (H, W, 3) RGB uint8, and its pose; `pixels` is None if it could not be read."""
        rerun, stream = self._rerun, self._stream
        stream.set_time("image", sequence=self._count)
        if pose.time_s is not None:
            stream.set_time("time", duration=pose.time_s)
        self._count += 1
        about = f"{pose.image}: {pose.status}, {pose.reason or f'radius {pose.radius_m:.3g}, {pose.inliers} inliers'}"
        stream.log("log", rerun.TextLog(about, level="INFO" if pose.accepted else "WARN"))
        if pose.accepted:  # where it is refused, the camera stays where it was
            self._trajectory.append(pose.position_m)
            w, x, y, z = pose.quat_wxyz
            stream.log(
                "world/camera",
                rerun.Transform3D(translation=pose.position_m, quaternion=rerun.Quaternion(xyzw=[x, y, z, w])),
            )
        self._add_radius(pose)
        if pixels is not None:
            self._add_image(pose, pixels)

    def close(self) -> None:
        """Write the whole trajectory, and what is left."""
        if self._trajectory:
            points = self._rerun.Points3D(self._trajectory, colors=BLUE)
            self._stream.log("world/trajectory", points, static=True)
        self._stream.disconnect()

    def _add_radius(self, pose: LocatedPose) -> None:
        """The sphere that holds 90 % of errors."""
        rerun = self._rerun
        if pose.accepted and math.isfinite(pose.radius_m):
            sphere = rerun.Ellipsoids3D(centers=[pose.position_m], half_sizes=[[pose.radius_m] * 3], colors=GREEN)
            self._stream.log("world/radius", sphere)
        else:
            self._stream.log("world/radius", rerun.Clear(recursive=False))

    def _add_image(self, pose: LocatedPose, pixels: np.ndarray) -> None:
        """The image in its camera, with the inliers."""
        rerun, stream = self._rerun, self._stream
        height, width = pixels.shape[:2]
        factor = min(1.0, LONGEST_PX / max(height, width))
        size = max(1, round(width * factor)), max(1, round(height * factor))
        shown = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA) if factor < 1 else pixels
        known = self._camera if self._camera is not None and has_shape(self._camera, width, height) else None
        focal = size[0] / 2 / math.tan(FIELD_OF_VIEW / 2)
        camera = Camera(*size, focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2) if known is None else known
        camera = camera.resize(*size)
        matrix = np.array([[camera.fx, 0, camera.cx + 0.5], [0, camera.fy, camera.cy + 0.5], [0, 0, 1.0]])
        stream.log("world/camera/image", rerun.Pinhole(image_from_camera=matrix, resolution=list(size)))
        stream.log("world/camera/image", rerun.Image(shown).compress(jpeg_quality=JPEG_QUALITY))
        inliers = np.zeros((0, 2)) if pose.inliers_px is None else (pose.inliers_px + 0.5) * factor
        stream.log("world/camera/image/inliers", rerun.Points2D(inliers, colors=GREEN, radii=2.0))
