"""A TUM trajectory beside a folder of images, or beside a video."""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.paths import cache_folder
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.image_files import IMAGE_FOLDERS, has_image_suffix, make_natural_key
from lightning_pose.scenes.formats.poses import check_quats
from lightning_pose.scenes.formats.text_files import list_files, read_lines, read_table
from lightning_pose.scenes.formats.tum import TRAJECTORY_COLUMNS, convert_to_seconds, pair_by_time
from lightning_pose.scenes.scene import Frame, Scene, Trajectory
from lightning_pose.scenes.video_files import VIDEO_SUFFIXES, read_frame_rate, write_frames

__all__ = ["FORMAT", "TrajectoryFile"]

log = logging.getLogger("lightning_pose")

NAMES = re.compile(r".*\.tum|(key_?frame_?|camera_?)?trajectory\.txt|groundtruth\.txt", re.IGNORECASE)
"""Names of trajectory files: of this project and of evo, of ORB-SLAM, and of the benchmark."""

MAX_FRAMES = 10_000_000
"""A video has no more; a trajectory with such times is of another clock."""


class TrajectoryFile(SceneFormat):
    """One TUM trajectory (`trajectory.txt` or `*.tum`), with images in the folder or in one below it, or one video.

    Poses are camera-to-world, metres. An image has the pose whose time is the number in its name, within 20 ms; times
    of other units than seconds are converted. Where a comment above a pose names an image, as in the trajectories that
    this project writes, that image has it. Poses of a video count seconds from its first frame, or have whole numbers
    that count its frames; its posed frames are written into the cache, once.
    """

    name = "trajectory"
    looks_for = "one trajectory.txt or *.tum, beside images or a video"

    def matches(self, root: Path) -> bool:
        from lightning_pose.scenes.formats import known_formats  # the package imports this module

        if len(_list_trajectories(root)) != 1 or any(
            other.matches(root) for other in known_formats().values() if other.name != self.name
        ):
            return False  # a trajectory may lie beside a dataset that has its own poses
        return bool(_list_images(root) or _list_videos(root))

    def read(self, root: Path) -> Scene:
        found = _list_trajectories(root)
        images, videos = _list_images(root), _list_videos(root)
        if len(found) != 1 or not (images or len(videos) == 1):
            names = ", ".join(path.name for path in [*found, *videos]) or "none"
            raise DataError(f"{root} needs one trajectory, and images or one video; it has {names}; remove the others")
        path = found[0]
        table = read_table(path, TRAJECTORY_COLUMNS)
        if not len(table.values):
            raise DataError(f"{path} has no pose; give `{TRAJECTORY_COLUMNS}` a line")
        times = convert_to_seconds(table.values[:, 0], table.header, path)
        position_m, quats, wrong = check_quats(table.values[:, 1:4], table.values[:, 4:], scalar_first=False)
        pairs = _pair_images(path, images, times) if images else _pair_video(path, videos[0], times)
        if not pairs:
            raise DataError(
                f"{root}: none of the {'images' if images else 'video frames'} has a pose in {path.name}, whose times "
                f"are {np.nanmin(times):.6f} to {np.nanmax(times):.6f}; name each image by its pose's time, in seconds"
            )
        faults = [table.faults[p.row] or (wrong[p.row] and f"{table.places[p.row]}: {wrong[p.row]}") for p in pairs]
        name = root.resolve().name
        frames = [
            Frame(pair.image, position_m[pair.row], quats[pair.row], name, i, pair.time_s)
            for i, pair in enumerate(pairs)
        ]
        usable, bad = keep_usable(frames, faults, path.name)
        sound = np.isfinite(times) & ~np.array([bool(fault) for fault in wrong])
        timed = None not in {pair.time_s for pair in pairs}
        known = Trajectory(times[sound], position_m[sound], quats[sound]) if timed else None
        return Scene(name, root, self.name, usable, bad_frames=bad, trajectory=known)


FORMAT = TrajectoryFile()


class _Pair(NamedTuple):
    """An image file, the row of its pose, and its time in seconds; None where only the pose's place is known."""

    image: Path
    row: int
    time_s: float | None


def _list_trajectories(root: Path) -> list[Path]:
    """Files of the folder that are trajectories by their names."""
    return [path for path in list_files(root) if NAMES.fullmatch(path.name) and path.is_file()] if root.is_dir() else []


def _list_images(root: Path) -> list[Path]:
    """The images of the folder, or else of the first folder below it that has any, in natural order."""
    for folder in (root, *(root / name for name in IMAGE_FOLDERS)):
        images = [path for path in list_files(folder) if has_image_suffix(path.name)] if folder.is_dir() else []
        if images:
            return sorted(images, key=lambda path: make_natural_key(path.name))
    return []


def _list_videos(root: Path) -> list[Path]:
    """The videos of the folder."""
    return [path for path in list_files(root) if path.suffix.lower() in VIDEO_SUFFIXES]


def _pair_images(path: Path, images: Sequence[Path], times: np.ndarray) -> list[_Pair]:
    """Images with their poses: by the names in comments, else by the times in names."""
    named = _read_names(path)
    by_name = {image.name: image for image in images}
    pairs = [_Pair(by_name[name], row, None) for row, name in named if name in by_name and row < len(times)]
    if pairs:
        return pairs
    stems = [re.sub(r"^[^0-9]*", "", image.stem) for image in images]
    own = np.array([float(stem) if re.fullmatch(r"[0-9]+(\.[0-9]+)?", stem) else np.nan for stem in stems])
    own = convert_to_seconds(own, [], path.parent)
    listed = np.flatnonzero(np.isfinite(own))
    paired = pair_by_time(own[listed], times)
    missed = len(images) - len(paired)
    if missed and len(paired):
        log.warning(
            "%s: dropped %d of %d images, no pose within 20 ms of the time in their name", path, missed, len(own)
        )
    return [_Pair(images[int(listed[i])], int(row), float(own[listed[i]])) for i, row in paired]


def _read_names(path: Path) -> list[tuple[int, str]]:
    """Rows of poses, and the names of images in the comments above them."""
    named, row, last = [], 0, ""
    for _, line in read_lines(path, comments=True):
        if line.startswith("#"):
            last = line[1:].strip().replace("\\", "/").rpartition("/")[2]
        elif re.match(r"[-+.0-9]", line):
            if has_image_suffix(last):
                named.append((row, last))
            row, last = row + 1, ""
    return named


def _pair_video(path: Path, video: Path, times: np.ndarray) -> list[_Pair]:
    """Frames of a video with their poses; they are written into the cache."""
    rate = read_frame_rate(video)
    whole = np.isfinite(times).all() and len(times) > 1 and bool((times == np.rint(times)).all())
    seconds = times / rate if whole else times
    start = np.nanmin(seconds)
    if not whole and start > 1e6:  # a clock's time: the first pose is that of the first frame
        log.warning("%s: times count from 1970 or the like; the first pose is taken for that of the first frame", path)
        seconds = seconds - start
    count = int(np.nanmax(seconds) * rate) + 2 if np.isfinite(seconds).any() else 0
    pairs = pair_by_time(np.arange(min(count, MAX_FRAMES)) / rate, seconds)
    facts = video.stat()
    key = hashlib.blake2b(f"{video.resolve()} {facts.st_size} {facts.st_mtime_ns}".encode(), digest_size=8).hexdigest()
    files = write_frames(video, pairs[:, 0].tolist(), cache_folder("videos") / f"{video.stem}-{key}")
    return [_Pair(file, int(row), float(seconds[row])) for file, row in zip(files, pairs[:, 1], strict=False)]
