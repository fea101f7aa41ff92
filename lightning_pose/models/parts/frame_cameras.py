"""The cameras of a data module's frames, as a landmark map needs them: one for each image as it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from lightning_pose.data.datamodule import SceneDataModule
from lightning_pose.geometry.camera import Camera
from lightning_pose.scenes.cameras import scale_camera

__all__ = ["find_frequent_camera", "list_cameras", "scale_cameras"]


def list_cameras(datamodule: SceneDataModule, frames: Iterable[int], fallback: Camera) -> list[Camera]:
    """The cameras of frames, by their indices in the scene; those that are unknown are the fallback's.

    Raises:
        ConfigError: a camera is for images of another shape.
    """
    found = []
    for frame in frames:
        camera = datamodule.find_camera(frame)
        if camera is None:
            image = datamodule.scene.frames[frame].image
            camera = scale_camera(fallback, *datamodule.measure_image(frame), image)
        found.append(camera)
    return found


def find_frequent_camera(datamodule: SceneDataModule, frames: Iterable[int]) -> tuple[Camera | None, int]:
    """The most frequent of the known cameras of frames, and how many known ones differ.

    Of several that are as frequent, it is the one with the middle focal length.

    Raises:
        ConfigError: as `list_cameras`.
    """
    known = Counter(camera for frame in frames if (camera := datamodule.find_camera(frame)) is not None)
    most = max(known.values(), default=0)
    often = sorted((camera for camera in known if known[camera] == most), key=lambda camera: camera.focal_px)
    return (often[len(often) // 2] if often else None), len(known)


def scale_cameras(camera: Camera, sizes: Sequence[tuple[int, int]]) -> list[Camera]:
    """One camera for images of these widths and heights.

    Raises:
        ConfigError: an image has another shape than those that the camera is for.
    """
    return [scale_camera(camera, *size, setting="camera") for size in sizes]
