"""The cameras of a scene's frames: one that the user gives for all, and each scaled to the size of its image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.camera import Camera
from lightning_pose.scenes.scene import Intrinsics, Scene

__all__ = ["apply_camera", "has_shape", "make_camera", "scale_camera"]

ASPECT_TOLERANCE = 0.02
"""Share by which an image's width by height may differ from its camera's: sizes are rounded to whole pixels."""


def apply_camera(scene: Scene, camera: Camera) -> Scene:
    """The scene with one camera for all its frames, in place of those of its format."""
    intrinsics = Intrinsics(
        camera.fx, camera.fy, camera.cx, camera.cy, (camera.width, camera.height), camera.distortion, camera.fisheye
    )
    return replace(scene, frames=tuple(replace(frame, intrinsics=intrinsics) for frame in scene.frames))


def make_camera(intrinsics: Intrinsics, width: int, height: int, image: str | Path) -> Camera:
    """A frame's camera for its image as it is, of this width and height in pixels.

    Raises:
        ConfigError: as `scale_camera`.
    """
    stated = intrinsics.size or (width, height)
    known = intrinsics
    camera = Camera(*stated, known.fx, known.fy, known.cx, known.cy, known.distortion, known.fisheye)
    return scale_camera(camera, width, height, image)


def scale_camera(
    camera: Camera, width: int, height: int, image: str | Path = "an image", setting: str = "data.camera"
) -> Camera:
    """A camera for an image that was shrunk or enlarged to this width and height in pixels.

    Args:
        camera: of the image before.
        width: of the image.
        height: of the image.
        image: its name, for the message.
        setting: where the user can give another camera, for the message.

    Raises:
        ConfigError: the image has another shape, so that it was cropped, squeezed or turned, nobody knows how.

    >>> scale_camera(Camera.parse("PINHOLE,640,480,500,500,319.5,239.5"), 320, 240).cx
    159.5
    """
    if not has_shape(camera, width, height):
        raise ConfigError(
            f"{image} has {width}x{height} pixels, and its camera is for {camera.width}x{camera.height}: it was "
            f"cropped, squeezed or turned; give {setting} for its own size, such as "
            f"PINHOLE,{width},{height},FX,FY,CX,CY"
        )
    return camera if (width, height) == (camera.width, camera.height) else camera.resize(width, height)


def has_shape(camera: Camera, width: int, height: int) -> bool:
    """Whether an image of this width and height has the shape of a camera's images, at any scale.

    >>> has_shape(Camera.parse("PINHOLE,640,480,500,500,319.5,239.5"), 480, 640)
    False
    """
    return abs(width * camera.height / (height * camera.width) - 1) <= max(ASPECT_TOLERANCE, 1 / min(width, height))
