"""TUM RGB-D (Sturm et al., IROS 2012): an image list and a trajectory, each with its own timestamps."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.image_files import (
    ImageFinder,
    choose_listed_images,
    has_image_suffix,
    parse_image_line,
    warn_of_unlisted_images,
)
from lightning_pose.scenes.formats.poses import check_quats
from lightning_pose.scenes.formats.text_files import NumberTable, find_file, list_files, read_lines, read_table
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene, Trajectory

__all__ = ["FORMAT", "TRAJECTORY_COLUMNS", "Tum", "convert_to_seconds", "is_numbered", "pair_by_time"]

log = logging.getLogger("lightning_pose")

TRAJECTORY_COLUMNS = "timestamp tx ty tz qx qy qz qw"
MAX_DIFFERENCE_S = 0.02
"""Largest difference in time between an image and its pose."""

CAMERAS = {
    "1": Intrinsics(517.3, 516.5, 318.6, 255.3, (640, 480), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": Intrinsics(520.9, 521.0, 325.1, 249.7, (640, 480), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": Intrinsics(535.4, 539.2, 320.1, 247.6, (640, 480)),  # its images are undistorted
}
"""The calibrated colour cameras of the benchmark, by their number."""

CAMERA_NAME = re.compile(r"(?<![a-z])(?:freiburg|fr)([123])(?!\d)", re.IGNORECASE)
"""How the benchmark names its recordings: `rgbd_dataset_freiburg1_rpy`, or short `fr1_rpy`."""


class Tum(SceneFormat):
    """`rgb.txt` with `timestamp path`, `groundtruth.txt` with `timestamp tx ty tz qx qy qz qw`.

    Poses are camera-to-world, metres; the quaternion is xyzw unless the header names another order. Images and poses
    are paired by time, one to one, within 20 ms; images without a pose are dropped with a warning. Times are seconds;
    nanoseconds, microseconds and milliseconds are recognised and converted, with a warning. The folder is one sequence.
    """

    name = "tum"
    looks_for = "rgb.txt and groundtruth.txt"

    def matches(self, root: Path) -> bool:
        files = [find_file(root, name) for name in ("rgb.txt", "groundtruth.txt")]
        return all(file.is_file() for file in files) and not is_numbered(root)

    def read(self, root: Path) -> Scene:
        listed = _read_timed_images(root, find_file(root, "rgb.txt"))
        trajectory = find_file(root, "groundtruth.txt")
        table = read_table(trajectory, TRAJECTORY_COLUMNS)
        _warn_of_rows_without_time(trajectory, table)
        pose_times = convert_to_seconds(table.values[:, 0], table.header, trajectory)
        _warn_of_equal_times(trajectory, pose_times)
        if _counts_frames(pose_times):
            log.warning("%s counts frames: if it is ICL-NUIM, with y up in the world, give format icl_nuim", trajectory)
        pairs = pair_by_time(listed.times, pose_times)
        if not len(pairs):
            raise DataError(
                f"{root}: none of the {len(listed.times)} images has a pose within 20 ms; rgb.txt spans "
                f"{_format_span(listed.times)}, groundtruth.txt {_format_span(pose_times)}; bring both to one clock"
            )
        missed = len(listed.times) - len(pairs)
        if missed:
            log.warning("%s: dropped %d of %d images, no pose within 20 ms", root, missed, len(listed.times))
        rows = pairs[:, 1]
        position_m, quats, found = check_quats(table.values[:, 1:4], table.values[:, 4:], scalar_first=False)
        faults = [table.faults[j] or (found[j] and f"{table.places[j]}: {found[j]}") for j in rows]
        sound = np.isfinite(pose_times) & ~np.array([bool(fault) for fault in found])
        known = Trajectory(pose_times[sound], position_m[sound], quats[sound])
        name = root.resolve().name
        camera = CAMERA_NAME.search(name)
        intrinsics = CAMERAS[camera[1]] if camera else None
        frames = [
            Frame(listed.images[i], position, quat, name, int(i), float(listed.times[i]), intrinsics)
            for i, position, quat in zip(pairs[:, 0], position_m[rows], quats[rows], strict=True)
        ]
        usable, bad = keep_usable(frames, faults, "rgb.txt")
        return Scene(name, root, self.name, usable, bad_frames=(*listed.faults, *bad), trajectory=known)


FORMAT = Tum()


class ImageList(NamedTuple):
    """Images by ascending time: (N,) seconds, N files; and the lines of the list that name no image, in words."""

    times: np.ndarray
    images: list[Path]
    faults: list[str]


def pair_by_time(times: np.ndarray, pose_times: np.ndarray) -> np.ndarray:
    """Pair images with poses by time: the closest pairs first, each image and each pose at most once.

    Args:
        times: (N,) seconds.
        pose_times: (M,) seconds, in any order; NaN where a pose has no time.

    Returns:
        (K, 2) pairs of an image's row and a pose's row, in the order of the images, at most 20 ms apart.
    """
    order = np.argsort(pose_times, kind="stable")  # NaN last
    first = np.searchsorted(pose_times[order], times - MAX_DIFFERENCE_S, side="left")
    last = np.searchsorted(pose_times[order], times + MAX_DIFFERENCE_S, side="right")
    candidates = [(i, order[j]) for i in range(len(times)) for j in range(first[i], last[i])]
    candidates.sort(key=lambda pair: abs(times[pair[0]] - pose_times[pair[1]]))
    pose_of: dict[int, int] = {}
    taken: set[int] = set()
    for image, pose in candidates:
        if image not in pose_of and pose not in taken:
            pose_of[image] = pose
            taken.add(pose)
    return np.array(sorted(pose_of.items()), dtype=int).reshape(-1, 2)


def is_numbered(root: Path) -> bool:
    """Whether a folder with `groundtruth.txt` is ICL-NUIM: its lines count frames, and the images are `rgb/N.png`.

    Frames are counted 0, 1, 2, ... or 1, 2, 3, ...; beside an `rgb.txt`, numbers with decimals are times.
    """
    images = root / "rgb"
    if not images.is_dir() or not any(path.stem.isdecimal() for path in list_files(images)):
        return False
    trajectory = find_file(root, "groundtruth.txt")
    if find_file(root, "rgb.txt").is_file() and any(
        "." in re.split(r"[\s,;]+", line)[0] for _, line in read_lines(trajectory)
    ):
        return False
    return _counts_frames(read_table(trajectory, TRAJECTORY_COLUMNS).values[:, 0])


def _counts_frames(numbers: np.ndarray) -> bool:
    """Whether numbers are 0, 1, 2, ... or 1, 2, 3, ..."""
    return len(numbers) > 1 and numbers[0] in (0, 1) and bool((np.diff(numbers) == 1).all())


def _read_timed_images(root: Path, path: Path) -> ImageList:
    """Read the image list.

    Raises:
        DataError: it lists no image.
    """
    finder = ImageFinder(root)
    header: list[str] = []
    found: list[tuple[float, Path]] = []
    faults: list[str] = []
    for number, line in read_lines(path, comments=True):
        if line.startswith("#"):
            header.append(line)
            continue
        try:
            time, listed = parse_image_line(line)
            if not np.isfinite(float(time)):
                raise ValueError(time)
            found.append((float(time), finder.find(listed)))
        except ValueError:
            if found or faults or has_image_suffix(line):
                faults.append(f"{path}:{number}: expected `timestamp path`, found `{line[:200]}`; fix it")
            else:
                header.append(line)
    if not found:
        raise DataError(faults[0] if faults else f"{path} lists no image; give one `timestamp path` a line")
    finder.warn(path.name)
    warn_of_unlisted_images((image for _, image in found), path.name)
    chosen = choose_listed_images(image for _, image in found)
    found = sorted(entry for entry in found if entry[1] in chosen)
    times = convert_to_seconds(np.array([time for time, _ in found]), header, path)
    return ImageList(times, [image for _, image in found], faults)


def convert_to_seconds(times: np.ndarray, header: Sequence[str], path: Path) -> np.ndarray:
    """Times in seconds, with a warning if the file has another unit.

    The unit is nanoseconds if the header names them. Otherwise it follows from the times: seconds since 1970 have 10
    digits, milliseconds 13, microseconds 16 and nanoseconds 19; of times that begin at zero, a step of 100,000 or more
    cannot be seconds.
    """
    finite = times[np.isfinite(times)]
    if not len(finite):
        return times
    largest = float(np.abs(finite).max())
    step = float(np.median(np.diff(np.unique(finite)))) if len(np.unique(finite)) > 1 else 0.0
    in_header = any(re.search(r"(?<![a-z])(?:ns|nsecs?|nanoseconds?)(?![a-z])", line.lower()) for line in header)
    if in_header or largest >= 1e17 or (largest < 1e11 and step >= 5e5):
        unit, per_second = "nanoseconds", 1e9
    elif largest >= 1e14 or (largest < 1e11 and step >= 1e5):
        unit, per_second = "microseconds", 1e6
    elif largest >= 1e11:
        unit, per_second = "milliseconds", 1e3
    else:
        return times
    log.warning("%s: the times are read as %s; write seconds if they are not", path, unit)
    return times / per_second


def _warn_of_rows_without_time(path: Path, table: NumberTable) -> None:
    """Log how many lines of a trajectory belong to no time, so that no image can use them."""
    without = np.flatnonzero(~np.isfinite(table.values[:, 0]))
    if len(without):
        log.warning(
            "%s: %d lines have no time and are not used, such as %s", path, len(without), table.places[without[0]]
        )


def _warn_of_equal_times(path: Path, times: np.ndarray) -> None:
    """Log a warning if most lines of a trajectory have the time of another line."""
    different = len(np.unique(times[np.isfinite(times)]))
    if 2 * different < len(times):
        log.warning("%s: %d lines have %d different times; write times with all digits", path, len(times), different)


def _format_span(times: np.ndarray) -> str:
    """First and last time, in words."""
    finite = times[np.isfinite(times)]
    return f"{finite.min():.3f} to {finite.max():.3f} s" if len(finite) else "nothing"
