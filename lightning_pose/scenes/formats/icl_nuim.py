"""ICL-NUIM (Handa et al., ICRA 2014), the TUM-compatible release: rendered rooms with exact poses."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.image_files import (
    ImageFinder,
    choose_images,
    has_image_suffix,
    parse_image_line,
    warn_of_unlisted_images,
)
from lightning_pose.scenes.formats.poses import check_quats
from lightning_pose.scenes.formats.text_files import find_file, list_files, read_lines, read_table
from lightning_pose.scenes.formats.tum import TRAJECTORY_COLUMNS, is_numbered
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene

__all__ = ["FORMAT", "IclNuim", "reflect_poses"]

log = logging.getLogger("lightning_pose")

CAMERA = Intrinsics(fx=481.20, fy=480.0, cx=319.5, cy=239.5, size=(640, 480))
FRAMES_PER_SECOND = 30.0
MAX_NUMBER = 10**9
"""A larger number is not that of a frame."""


class IclNuim(SceneFormat):
    """A trajectory whose first column is the frame's number N, and the images `rgb/N.png`.

    The trajectory is `*.gt.freiburg` (`livingRoom2.gt.freiburg`, `traj0.gt.freiburg`), or a
    `groundtruth.txt` that counts 0, 1, 2, ... or 1, 2, 3, ...; its other columns are those of TUM. The images are
    those of `associations.txt` or `rgb.txt` (of two images in a line, the one whose path has rgb), or of the folder
    `rgb`; an image without a pose, as each release has one, is dropped with a warning. Timestamps are N / 30 s.

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
        table = read_table(trajectory, TRAJECTORY_COLUMNS.replace("timestamp", "frame"))
        row_of = {int(number): row for row, number in enumerate(table.values[:, 0]) if abs(number) < MAX_NUMBER}
        images = _find_images(root)
        posed = sorted(images.keys() & row_of.keys())
        if not posed:
            raise DataError(f"{root}: no image's number is in {trajectory.name}; name them rgb/1.png ...")
        if len(posed) < len(images):
            log.warning("%s: dropped %d of %d images, no pose", root, len(images) - len(posed), len(images))
        rows = [row_of[number] for number in posed]
        position_m, quats, found = check_quats(table.values[rows, 1:4], table.values[rows, 4:], scalar_first=False)
        position_m, quats = reflect_poses(position_m, quats)
        faults = [
            table.faults[j] or (wrong and f"{table.places[j]}: {wrong}") for j, wrong in zip(rows, found, strict=True)
        ]
        name = root.resolve().name
        frames = [
            Frame(images[number], position, quat, name, number, number / FRAMES_PER_SECOND, CAMERA)
            for number, position, quat in zip(posed, position_m, quats, strict=True)
        ]
        usable, bad = keep_usable(frames, faults, "the image list")
        return Scene(name, root, self.name, usable, ground_truth="synthetic", bad_frames=bad)


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
    """The file with the poses, None if there is none.

    Raises:
        DataError: there are several `*.gt.freiburg`.
    """
    published = [path for path in list_files(root) if path.name.lower().endswith(".gt.freiburg")]
    if len(published) > 1:
        names = ", ".join(path.name for path in published)
        raise DataError(f"{root} has {len(published)} trajectories, {names}; keep the one that belongs to the images")
    ours = find_file(root, "groundtruth.txt")
    if published:
        return published[0]
    return ours if ours.is_file() and is_numbered(root) else None


def _find_images(root: Path) -> dict[int, Path]:
    """Image files by the numbers of their frames."""
    lists = [path for path in (find_file(root, name) for name in ("associations.txt", "rgb.txt")) if path.is_file()]
    if lists:
        paths = _list_colour_images(root, lists[0])
    else:
        paths = [path for path in list_files(root / "rgb") if has_image_suffix(path.name)]
    candidates: dict[int, list[Path]] = {}
    for path in dict.fromkeys(paths):
        if not path.stem.isdecimal() or len(path.stem) > 9:
            raise DataError(f"{path} is not named by its frame's number; rename it like rgb/1.png")
        candidates.setdefault(int(path.stem), []).append(path)
    return choose_images(candidates)


def _list_colour_images(root: Path, path: Path) -> list[Path]:
    """The colour images that a list names.

    Raises:
        DataError: a line lists no image.
    """
    finder = ImageFinder(root)
    paths = []
    for number, line in read_lines(path):
        try:
            paths.append(finder.find(parse_image_line(line)[1]))
        except ValueError:
            raise DataError(
                f"{path}:{number}: expected `number path`, found `{line[:200]}`; correct the line"
            ) from None
    finder.warn(path.name)
    warn_of_unlisted_images(paths, path.name)
    return paths
