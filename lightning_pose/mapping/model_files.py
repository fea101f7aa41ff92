"""Writes a reconstruction for other programs: as a COLMAP model in text files, and as PLY files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.camera import CAMERA_MODELS, Camera
from lightning_pose.mapping.camera_correction import CameraCorrection

__all__ = ["Reconstruction", "correct_camera", "write_colmap_model", "write_ply_files"]


@dataclass(frozen=True)
class Reconstruction:
    """F posed images and P points that they see, in O observations.

    Attributes:
        names: F image files, as the program that reads the model should find them.
        cameras: F, with the centre of the first pixel at (0, 0).
        rotation: (F, 3, 3), camera-to-world.
        position: (F, 3), in the scene's unit.
        points: (P, 3).
        colors: (P, 3) uint8 RGB.
        seen_frame: (O,) int64, the image of each observation, ascending.
        seen_point: (O,) int64, its point.
    """

    names: Sequence[str]
    cameras: Sequence[Camera]
    rotation: np.ndarray
    position: np.ndarray
    points: np.ndarray
    colors: np.ndarray
    seen_frame: np.ndarray
    seen_point: np.ndarray

    def project_observations(self) -> np.ndarray:
        """(O, 2) pixels where each observation's point appears in its image."""
        frame = self.seen_frame
        away = self.points[self.seen_point] - self.position[frame]
        local = np.einsum("oji,oj->oi", self.rotation[frame], away)
        pixels = local[:, :2] / local[:, 2:]
        for i, camera in enumerate(self.cameras):
            pixels[frame == i] = camera.project(pixels[frame == i])
        return pixels


def correct_camera(camera: Camera, correction: CameraCorrection) -> Camera:
    """A camera as bundle adjustment has it: exact for one without distortion, and to first order for others."""
    k1 = (camera.distortion[0] if camera.distortion else 0.0) + correction.k1
    distortion = (k1, *(camera.distortion[1:] or (0.0, 0.0, 0.0))) if k1 or camera.distortion else ()
    return replace(
        camera,
        fx=camera.fx * correction.scale,
        fy=camera.fy * correction.scale,
        cx=camera.cx + camera.fx * float(correction.centre[0]),
        cy=camera.cy + camera.fy * float(correction.centre[1]),
        distortion=distortion,
    )


def write_colmap_model(folder: Path, model: Reconstruction) -> list[Path]:
    """Write `cameras.txt`, `images.txt` and `points3D.txt`, as COLMAP's text models have them.

    Pixels are counted from the corner of the first pixel there, poses are world-to-camera. Observations lie where the
    points appear, because a map does not keep where keypoints were.

    Returns:
        the files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    numbers = {camera: i for i, camera in enumerate(dict.fromkeys(model.cameras), start=1)}
    files = {
        "cameras.txt": (f"{i} {_format_camera(camera)}" for camera, i in numbers.items()),
        "images.txt": _list_images(model, numbers),
        "points3D.txt": _list_points(model),
    }
    heads = {
        "cameras.txt": "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        "images.txt": "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then POINTS2D[] as (X, Y, POINT3D_ID)",
        "points3D.txt": "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    }
    for name, lines in files.items():
        (folder / name).write_text("".join(f"{line}\n" for line in (f"# {heads[name]}", *lines)), encoding="utf-8")
    return [folder / name for name in files]


def _format_camera(camera: Camera) -> str:
    """A line of `cameras.txt`; 0.5 takes the principal point to COLMAP's pixels."""
    shifted = replace(camera, cx=camera.cx + 0.5, cy=camera.cy + 0.5)
    model, *numbers = str(shifted).split(",")
    assert model in CAMERA_MODELS
    return " ".join([model, *numbers])


def _list_images(model: Reconstruction, numbers: dict[Camera, int]) -> Iterable[str]:
    """Two lines an image: its pose, and what it sees."""
    world_to_cam = Rotation.from_matrix(model.rotation).inv()
    quats = world_to_cam.as_quat(canonical=True, scalar_first=True)
    shift = -world_to_cam.apply(model.position)
    pixels = model.project_observations() + 0.5
    ends = np.searchsorted(model.seen_frame, np.arange(len(model.names) + 1))
    for i, name in enumerate(model.names):
        pose = " ".join(f"{value:.12g}" for value in (*quats[i], *shift[i]))
        yield f"{i + 1} {pose} {numbers[model.cameras[i]]} {name}"
        rows = range(ends[i], ends[i + 1])
        yield " ".join(f"{pixels[o, 0]:.4f} {pixels[o, 1]:.4f} {model.seen_point[o] + 1}" for o in rows)


def _list_points(model: Reconstruction) -> Iterable[str]:
    """A line a point; -1 is COLMAP's error of a point whose error is not known."""
    first = np.searchsorted(model.seen_frame, model.seen_frame)
    row_in_image = np.arange(len(first)) - first
    order = np.argsort(model.seen_point, kind="stable")
    ends = np.searchsorted(model.seen_point[order], np.arange(len(model.points) + 1))
    for i, (point, color) in enumerate(zip(model.points, model.colors, strict=True)):
        track = " ".join(f"{model.seen_frame[o] + 1} {row_in_image[o]}" for o in order[ends[i] : ends[i + 1]])
        yield f"{i + 1} {' '.join(f'{x:.12g}' for x in point)} {' '.join(map(str, color))} -1 {track}"


def write_ply_files(folder: Path, model: Reconstruction) -> list[Path]:
    """Write `points.ply`, the points with their colours, and `cameras.ply`, each camera's view as a pyramid of lines.

    A pyramid is as high as a twentieth of the median distance from cameras to points.

    Returns:
        the files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rgb = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    xyz = "property double x\nproperty double y\nproperty double z\n"
    points, cameras = folder / "points.ply", folder / "cameras.ply"
    rows = (
        f"{' '.join(f'{x:.9g}' for x in point)} {' '.join(map(str, color))}\n"
        for point, color in zip(model.points, model.colors, strict=True)
    )
    points.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(model.points)}\n{xyz}{rgb}end_header\n{''.join(rows)}"
    )
    distance = np.linalg.norm(model.points[model.seen_point] - model.position[model.seen_frame], axis=1)
    height = 0.05 * (float(np.median(distance)) if len(distance) else 1.0)
    corners = np.array([[0, 0, 0], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]) * height
    edges = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])
    half_view = np.array([[*camera.half_view, 1.0] for camera in model.cameras])
    vertices = np.einsum("fij,fkj->fki", model.rotation, corners * half_view[:, None]) + model.position[:, None]
    lines = (edges + 5 * np.arange(len(model.names))[:, None, None]).reshape(-1, 2)
    cameras.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {5 * len(model.names)}\n{xyz}"
        f"element edge {len(lines)}\nproperty int vertex1\nproperty int vertex2\nend_header\n"
        + "".join(f"{x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices.reshape(-1, 3))
        + "".join(f"{a} {b}\n" for a, b in lines)
    )
    return [points, cameras]
