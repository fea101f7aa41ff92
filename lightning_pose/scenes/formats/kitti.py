"""KITTI odometry (Geiger et al., CVPR 2012): drives of a car, with poses of its left gray camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.image_files import has_image_suffix
from lightning_pose.scenes.formats.poses import check_matrices
from lightning_pose.scenes.formats.text_files import list_files, parse_numbers, read_lines
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene

__all__ = ["FORMAT", "Kitti"]

CAMERAS = (2, 0, 3, 1)
"""Cameras by preference: left colour, left gray, right colour, right gray."""


class Kitti(SceneFormat):
    """A folder `sequences/NN` with `image_0` ... `image_3`, `calib.txt` and `times.txt`; poses in `poses/NN.txt`.

    The poses may also be `poses.txt` in the folder. A line is a 3x4 matrix, camera 0 to world, metres, OpenCV axes.
    The left colour camera is read where it is there; its place beside camera 0 follows from `calib.txt`, whose lines
    `P0:` ... `P3:` are 3x4 projection matrices.
    """

    name = "kitti"
    looks_for = "image_0 or image_2, calib.txt, and poses.txt or ../../poses/NN.txt"

    def matches(self, root: Path) -> bool:
        return _find_camera(root) is not None and (root / "calib.txt").is_file() and _find_poses(root).is_file()

    def read(self, root: Path) -> Scene:
        camera, poses = _find_camera(root), _find_poses(root)
        if camera is None:
            raise DataError(f"{root} has no images; unpack them into {root / 'image_2'} or image_0")
        images = [path for path in list_files(root / f"image_{camera}") if has_image_suffix(path.name)]
        lines = read_lines(poses)
        if len(lines) != len(images):
            raise DataError(f"{poses} has {len(lines)} poses for {len(images)} images; restore both")
        projection = _read_projection(root / "calib.txt", camera)
        matrix, offset = projection[:, :3], np.linalg.solve(projection[:, :3], projection[:, 3])
        T_world_cam, faults = np.full((len(lines), 4, 4), np.nan), []
        for row, (number, line) in enumerate(lines):
            fault = ""
            try:
                T_world_cam[row] = np.vstack([parse_numbers(line, 12).reshape(3, 4), [0, 0, 0, 1]])
            except ValueError as error:
                fault = f"{poses}:{number}: not a 3x4 matrix of numbers ({error}); correct the line"
            faults.append(fault)
        T_world_cam[:, :3, 3] -= T_world_cam[:, :3, :3] @ offset  # x_camera = x_0 + offset
        position_m, quats, found = check_matrices(T_world_cam)
        faults = [
            fault or (wrong and f"{poses}:{number}: {wrong}")
            for fault, wrong, (number, _) in zip(faults, found, lines, strict=True)
        ]
        name, times = root.resolve().name, _read_times(root / "times.txt", len(images))
        fx, fy, cx, cy = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        intrinsics = Intrinsics(fx, fy, cx, cy)
        frames = [
            Frame(image, position_m[i], quats[i], name, i, times[i], intrinsics) for i, image in enumerate(images)
        ]
        usable, bad = keep_usable(frames, faults)
        return Scene(name, root, self.name, usable, bad_frames=bad)


FORMAT = Kitti()


def _find_camera(root: Path) -> int | None:
    """The number of the camera whose images are read; None if there are none."""
    return next((number for number in CAMERAS if (root / f"image_{number}").is_dir()), None)


def _find_poses(root: Path) -> Path:
    """The file of the poses, which may be missing."""
    beside = root / "poses.txt"
    return beside if beside.is_file() else root.resolve().parent.parent / "poses" / f"{root.resolve().name}.txt"


def _read_projection(path: Path, camera: int) -> np.ndarray:
    """The (3, 4) projection matrix of a camera."""
    for number, line in read_lines(path):
        key, _, value = line.partition(":")
        if key.strip() == f"P{camera}":
            try:
                projection = parse_numbers(value, 12).reshape(3, 4)
            except ValueError:
                projection = np.zeros((3, 4))
            if np.isfinite(projection).all() and projection[0, 0] > 0 and projection[1, 1] > 0 and projection[2, 2]:
                return projection
            raise DataError(f"{path}:{number}: expected 12 numbers of a projection matrix; restore the original")
    raise DataError(f"{path} has no line `P{camera}:`; restore the original")


def _read_times(path: Path, count: int) -> list[float | None]:
    """Seconds of each image; None where the file is missing or has another number of lines."""
    if not path.is_file():
        return [None] * count
    try:
        times = [float(line) for _, line in read_lines(path)]
    except ValueError:
        raise DataError(f"{path}: expected one number of seconds a line; restore the original") from None
    return list(times) if len(times) == count else [None] * count
