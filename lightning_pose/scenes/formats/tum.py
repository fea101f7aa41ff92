"""TUM RGB-D (Sturm et al., IROS 2012): an image list and a trajectory, each with its own timestamps."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, read_lines, read_table, require_images, unit_quats
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene

__all__ = ["FORMAT", "TRAJECTORY_COLUMNS", "Tum", "is_numbered", "pair_by_time"]

log = logging.getLogger("lightning_pose")

TRAJECTORY_COLUMNS = "timestamp tx ty tz qx qy qz qw"
MAX_DIFFERENCE_S = 0.02
"""Largest difference in time between an image and its pose."""

CAMERAS = {
    "freiburg1": Intrinsics(517.3, 516.5, 318.6, 255.3, (640, 480), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": Intrinsics(520.9, 521.0, 325.1, 249.7, (640, 480), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": Intrinsics(535.4, 539.2, 320.1, 247.6, (640, 480)),  # its images are undistorted
}
"""The calibrated colour cameras of the benchmark, by a part of the folder's name."""


class Tum(SceneFormat):
    """`rgb.txt` with `timestamp path`, `groundtruth.txt` with `timestamp tx ty tz qx qy qz qw`.

    Poses are camera-to-world, metres; the quaternion is xyzw. Images and poses are paired by time, one to
    one, within 20 ms; images without a pose are dropped with a warning. The folder is one sequence.
    """

    name = "tum"
    looks_for = "rgb.txt and groundtruth.txt"

    def matches(self, root: Path) -> bool:
        trajectory = root / "groundtruth.txt"
        return (root / "rgb.txt").is_file() and trajectory.is_file() and not is_numbered(trajectory)

    def read(self, root: Path) -> Scene:
        times, images = _read_image_list(root / "rgb.txt")
        table, where = read_table(root / "groundtruth.txt", TRAJECTORY_COLUMNS)
        pairs = pair_by_time(times, table[:, 0])
        if not len(pairs):
            raise DataError(
                f"{root}: none of the {len(times)} images has a pose within 20 ms; "
                f"rgb.txt spans {_format_span(times)}, groundtruth.txt {_format_span(table[:, 0])}; "
                "bring both to one clock"
            )
        if len(pairs) < len(times):
            log.warning("%s: dropped %d of %d images, no pose within 20 ms", root, len(times) - len(pairs), len(times))
        quats = unit_quats(table[:, 4:], where, scalar_first=False)
        name = root.resolve().name
        intrinsics = next((camera for key, camera in CAMERAS.items() if key in name), None)
        frames = tuple(
            Frame(root / images[i], table[j, 1:4], quats[j], name, int(i), float(times[i]), intrinsics)
            for i, j in pairs
        )
        require_images((frame.image for frame in frames), "rgb.txt")
        return Scene(name, root, self.name, frames)


FORMAT = Tum()


def pair_by_time(times: np.ndarray, pose_times: np.ndarray) -> np.ndarray:
    """Pair images with poses by time: the closest pairs first, each image and each pose at most once.

    Args:
        times: (N,) seconds.
        pose_times: (M,) seconds, in any order.

    Returns:
        (K, 2) pairs of an image's row and a pose's row, in the order of the images, at most 20 ms apart.
    """
    order = np.argsort(pose_times, kind="stable")
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


def is_numbered(trajectory: Path) -> bool:
    """Whether the first column counts frames (0, 1, 2, ... or 1, 2, 3, ...) and has no times."""
    numbers = [line.split()[0] for _, line in read_lines(trajectory)]
    return numbers[:1] in (["0"], ["1"]) and all(
        number == str(int(numbers[0]) + row) for row, number in enumerate(numbers)
    )


def _read_image_list(path: Path) -> tuple[np.ndarray, list[str]]:
    """Read the image list: times in seconds, ascending, and the paths as listed, in the same order."""
    entries = []
    for number, line in read_lines(path):
        try:
            time, image = line.split(maxsplit=1)
            entries.append((float(time), image))
        except ValueError:
            raise DataError(f"{path}:{number}: expected `timestamp path`, found `{line}`; fix it") from None
    if not entries:
        raise DataError(f"{path} lists no image; give one `timestamp path` a line")
    entries.sort()
    return np.array([time for time, _ in entries]), [image for _, image in entries]


def _format_span(times: np.ndarray) -> str:
    """First and last time, in words."""
    return f"{times.min():.3f} to {times.max():.3f} s" if len(times) else "nothing"
