"""What EXIF says of an image: how to turn it upright, and the focal length where no camera is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.camera import Camera
from lightning_pose.localization.inputs import LoadedImage
from lightning_pose.localization.located_pose import LocatedPose
from lightning_pose.scenes.cameras import has_shape, scale_camera

__all__ = ["choose_camera", "count_turns", "turn_back", "turn_camera", "turn_prior"]

TURNS = {3: 2, 6: 1, 8: 3}
"""Quarters clockwise that bring an image of this EXIF orientation upright. Mirrored ones are left as they are."""

FILM_DIAGONAL_MM = float(np.hypot(36.0, 24.0))

OTHER_LENS = 0.1
"""EXIF's focal length replaces that of a map's camera if it differs by more than this share; EXIF rounds it."""


def count_turns(image: LoadedImage) -> int:
    """Quarters clockwise that bring an image upright; 0 if it is, or is mirrored."""
    return TURNS.get(image.orientation, 0)


def choose_camera(image: LoadedImage, view: Camera, camera: Camera | None) -> tuple[Camera, tuple[str, ...]]:
    """The camera of an image, with a note where EXIF gave it.

    That which the user gives; else that of the map's images, unless the image has another shape, or EXIF's focal
    length is of another lens. Then it has EXIF's focal length, its centre as principal point, and no distortion.

    Args:
        image: to be located.
        view: the camera of the map's images.
        camera: given by the user, or None.

    Raises:
        ConfigError: the image has another shape than the camera's images, and EXIF has no focal length.
    """
    width, height = image.size
    if camera is not None or image.focal_35mm is None:
        return scale_camera(camera or view, width, height, image.name or "an image", "camera"), ()
    focal_px = image.focal_35mm * float(np.hypot(width, height)) / FILM_DIAGONAL_MM
    if has_shape(view, width, height):
        known = scale_camera(view, width, height)
        if abs(focal_px / known.focal_px - 1) <= OTHER_LENS:
            return known, ()
    found = Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    return found, (f"camera from EXIF: {image.focal_35mm:g} mm on film, {focal_px:.0f} px",)


def turn_camera(camera: Camera, quarters: int) -> Camera:
    """The camera of images that are turned clockwise by so many quarters.

    >>> turn_camera(Camera.parse("PINHOLE,640,480,500,510,300,200"), 1)
    Camera(width=480, height=640, fx=510.0, fy=500.0, cx=279.0, cy=300.0, distortion=(), fisheye=False)
    """
    for _ in range(quarters % 4):
        distortion = camera.distortion
        if len(distortion) >= 4 and not camera.fisheye:
            k1, k2, p1, p2, *more = distortion
            distortion = (k1, k2, p2, -p1, *more)
        camera = Camera(
            camera.height,
            camera.width,
            camera.fy,
            camera.fx,
            camera.height - 1 - camera.cy,
            camera.cx,
            distortion,
            camera.fisheye,
        )
    return camera


def turn_prior(prior: CameraPose, quarters: int) -> CameraPose:
    """The pose of an image that is turned clockwise by so many quarters, from that of its pixels as stored."""
    return CameraPose(prior.rotation @ _turn_about_axis(quarters).T, prior.position)


def turn_back(pose: LocatedPose, image: LoadedImage, quarters: int) -> LocatedPose:
    """The pose of the pixels as stored, from that of the image turned clockwise by so many quarters.

    Args:
        pose: of the turned image.
        image: as stored.
        quarters: by which it was turned.
    """
    half = quarters * np.pi / 4
    w, x, y, z = pose.quat_wxyz
    cos, sin = np.cos(half), np.sin(half)
    quat_wxyz = np.array([w * cos - z * sin, x * cos + y * sin, y * cos - x * sin, w * sin + z * cos])
    inliers_px = pose.inliers_px
    if inliers_px is not None:
        width, height = image.size
        centre = np.array([(width - 1) / 2, (height - 1) / 2], np.float32)
        turned_centre = centre[::-1] if quarters % 2 else centre
        inliers_px = (inliers_px - turned_centre) @ _turn_about_axis(quarters)[:2, :2].astype(np.float32) + centre
    note = f"turned upright by EXIF orientation {image.orientation} to be located; the pose is of the pixels as stored"
    return replace(pose, quat_wxyz=quat_wxyz, inliers_px=inliers_px, notes=(*pose.notes, note))


def _turn_about_axis(quarters: int) -> np.ndarray:
    """(3, 3), directions in the camera as stored to those in the turned one: right becomes down after one quarter."""
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
