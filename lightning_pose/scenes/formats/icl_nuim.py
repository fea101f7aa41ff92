"""ICL-NUIM (Handa et al., ICRA 2014), the TUM-compatible release: rendered rooms with exact poses."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import (
    SceneFormat,
    make_natural_key,
    read_lines,
    read_table,
    require_images,
    unit_quats,
)
from lightning_pose.scenes.formats.tum import TRAJECTORY_COLUMNS, is_numbered
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene

__all__ = ["FORMAT", "IclNuim", "reflect_poses"]

log = logging.getLogger("lightning_pose")

CAMERA = Intrinsics(fx=481.20, fy=480.0, cx=319.5, cy=239.5, size=(640, 480))
FRAMES_PER_SECOND = 30.0


class IclNuim(SceneFormat):
    """A trajectory whose first column is the frame's number N, and the images `rgb/N.png`.

    The trajectory is `*.gt.freiburg` (`livingRoom2.gt.freiburg`, `traj0.gt.freiburg`), or a
    `groundtruth.txt` that counts 0, 1, 2, ... or 1, 2, 3, ...; its other columns are those of TUM. The images are
    those of `associations.txt` or `rgb.txt` (the last column is the path), or of the folder `rgb`; an image
    without a pose, as each release has one, is dropped with a warning. Timestamps are N / 30 s.

    In the world of the poses y points up, while the images are stored from top to bottom, so the poses are reflected.
    The published fy = -480 means the same; here fy is +480. A numbered trajectory that already has OpenCV axes is no
    ICL-NUIM: read it with format `tum`.
    """

    name = "icl_nuim"
    looks_for = "*.gt.freiburg (or groundtruth.txt with frame numbers) and rgb/N.png"

    def matches(self, root: Path) -> bool:
        return (root / "rgb").is_dir() and _find_trajectory(root) is not None

    def read(self, root: Path) -> Scene:
        trajectory = _find_trajectory(root)
        if trajectory is None:
            raise DataError(f"{root} has no *.gt.freiburg and no numbered groundtruth.txt; add one")
        if trajectory.name == "groundtruth.txt":
            log.warning(
                "%s counts frames: read as ICL-NUIM, with y up in the world; if it is not, give format tum",
                trajectory,
            )
        table, where = read_table(trajectory, TRAJECTORY_COLUMNS.replace("timestamp", "frame"))
        row_of = {int(number): row for row, number in enumerate(table[:, 0])}
        images = _find_images(root)
        posed = sorted(images.keys() & row_of.keys())
        if not posed:
            raise DataError(f"{root}: no image's number is in {trajectory.name}; name them rgb/1.png ...")
        if len(posed) < len(images):
            log.warning("%s: dropped %d of %d images, no pose", root, len(images) - len(posed), len(images))
        require_images((images[number] for number in posed), "the image list")
        rows = [row_of[number] for number in posed]
        positions, quats = reflect_poses(table[rows, 1:4], unit_quats(table[:, 4:], where, scalar_first=False)[rows])
        name = root.resolve().name
        frames = tuple(
            Frame(images[number], position, quat, name, number, number / FRAMES_PER_SECOND, CAMERA)
            for number, position, quat in zip(posed, positions, quats, strict=True)
        )
        return Scene(name, root, self.name, frames, ground_truth="synthetic")


FORMAT = IclNuim()


def reflect_poses(positions_m: np.ndarray, quats_wxyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reverse the y axes of world and camera: S T S with S = diag(1, -1, 1, 1).

    The position (x, y, z) becomes (x, -y, z). A rotation's axis is an axial vector, so a mirror flips the
    components within its plane: (w, x, y, z) becomes (w, -x, y, -z).

    Args:
        positions_m: (N, 3).
        quats_wxyz: (N, 4).

    Returns:
        positions (N, 3) and quaternions (N, 4).
    """
    return positions_m * [1, -1, 1], quats_wxyz * [1, -1, 1, -1]


def _find_trajectory(root: Path) -> Path | None:
    """The file with the poses, None if there is none; the first by name if there are several."""
    published = sorted(root.glob("*.gt.freiburg"))
    ours = root / "groundtruth.txt"
    if published:
        return published[0]
    return ours if ours.is_file() and is_numbered(ours) else None


def _find_images(root: Path) -> dict[int, Path]:
    """Image files by the numbers of their frames."""
    lists = [root / name for name in ("associations.txt", "rgb.txt") if (root / name).is_file()]
    if lists:
        paths = [root / line.split()[-1] for _, line in read_lines(lists[0])]
    else:
        paths = sorted((root / "rgb").glob("*.png"), key=lambda path: make_natural_key(path.name))
    for path in paths:
        if not path.stem.isdecimal():
            raise DataError(f"{path} is not named by its frame's number; rename it like rgb/1.png")
    return {int(path.stem): path for path in paths}
