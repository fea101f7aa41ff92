"""The layout of ACE (Brachmann et al., CVPR 2023) and DSAC*: `train` and `test`, each with `rgb` and `poses`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.image_files import choose_images, has_image_suffix
from lightning_pose.scenes.formats.poses import check_matrices
from lightning_pose.scenes.formats.text_files import list_files, parse_numbers, read_matrix, read_text
from lightning_pose.scenes.images import measure_image, read_bytes
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene

__all__ = ["FORMAT", "Ace"]

NUMBER = re.compile(r"\d{1,9}(?!.*\d)")
"""The last number of a name, which counts the frames of a sequence."""


class Ace(SceneFormat):
    """`train/rgb`, `train/poses` and `train/calibration`, and the same in `test`, one file a frame, sorted alike.

    A pose file is a 4x4 camera-to-world matrix in metres, OpenCV axes. A calibration file is a focal length in pixels,
    for a principal point in the middle of the image, or a 3x3 camera matrix. Images and files belong together by their
    order, as in ACE; their numbers must agree where names have as many. What stands in a name before the last number is
    its sequence. Frames whose pose has NaN or infinite entries are unusable.
    """

    name = "ace"
    looks_for = "train/rgb and train/poses, test/rgb and test/poses"

    def matches(self, root: Path) -> bool:
        return all((root / split / part).is_dir() for split in ("train", "test") for part in ("rgb", "poses"))

    def read(self, root: Path) -> Scene:
        frames, faults, split_of = [], [], {}
        for split in ("train", "test"):
            listed = _read_split(root / split)
            matrices, found = _read_poses(listed)
            position_m, quats, wrong = check_matrices(matrices)
            for i, image in enumerate(listed.images):
                sequence, index = _parse_name(image.stem, i)
                frame = Frame(
                    image, position_m[i], quats[i], f"{split}/{sequence}", index, intrinsics=listed.cameras[i]
                )  # fmt: skip
                frames.append(frame)
                faults.append(found[i] or (wrong[i] and f"{listed.poses[i]}: {wrong[i]}"))
                split_of[image] = split
        usable, bad = keep_usable(frames, faults)
        tested = np.array([split_of[frame.image] == "test" for frame in usable], dtype=bool)
        splits = {"train": np.flatnonzero(~tested), "test": np.flatnonzero(tested)}
        return Scene(root.resolve().name, root, self.name, usable, splits, bad_frames=bad)


FORMAT = Ace()


class SplitFiles(NamedTuple):
    """The files of a split, frame by frame: N images, N pose files, N cameras or None."""

    images: list[Path]
    poses: list[Path]
    cameras: list[Intrinsics | None]


def _read_split(folder: Path) -> SplitFiles:
    """The files of a split, and its cameras.

    Raises:
        DataError: there are none, or not as many of one kind as of the other.
    """
    by_stem: dict[str, list[Path]] = {}
    for path in list_files(folder / "rgb"):
        if has_image_suffix(path.name):
            by_stem.setdefault(path.stem, []).append(path)
    images = list(choose_images(by_stem).values())
    poses = [path for path in list_files(folder / "poses") if path.suffix == ".txt"]
    if not images or len(images) != len(poses):
        raise DataError(
            f"{folder} has {len(images)} images in rgb and {len(poses)} files in poses; they belong together one by one"
        )
    for image, pose in zip(images, poses, strict=True):
        if _find_numbers(image) != _find_numbers(pose) and len(_find_numbers(image)) == len(_find_numbers(pose)):
            raise DataError(f"{image.name} and {pose.name} stand at the same place of {folder} and have other numbers")
    calibrations = list_files(folder / "calibration") if (folder / "calibration").is_dir() else []
    if not calibrations:
        return SplitFiles(images, poses, [None] * len(images))
    if len(calibrations) not in (1, len(images)):
        raise DataError(f"{folder} has {len(images)} images and {len(calibrations)} files in calibration; give as many")
    facts = measure_image(read_bytes(images[0]), images[0])
    read: list[Intrinsics | None] = [_read_camera(path, facts.width, facts.height) for path in calibrations]
    return SplitFiles(images, poses, read if len(read) > 1 else read * len(images))


def _read_camera(path: Path, width: int, height: int) -> Intrinsics:
    """The camera of a calibration file, for images of this size."""
    try:
        numbers = parse_numbers(read_text(path))
        fx, fy, cx, cy = numbers[[0, 4, 2, 5]] if len(numbers) == 9 else (*numbers, *numbers, width / 2, height / 2)
    except (ValueError, DataError):
        raise DataError(f"{path}: expected a focal length or a 3x3 camera matrix; restore the original") from None
    if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy) > 0):
        raise DataError(f"{path}: the focal length is {fx:g}; restore the original")
    return Intrinsics(float(fx), float(fy), float(cx), float(cy), (width, height))


def _read_poses(files: SplitFiles) -> tuple[np.ndarray, list[str]]:
    """(N, 4, 4) matrices, NaN where a file has none, and what is wrong with each file."""
    matrices, faults = np.full((len(files.poses), 4, 4), np.nan), []
    for row, path in enumerate(files.poses):
        fault = ""
        try:
            matrices[row] = read_matrix(path)
        except (ValueError, DataError) as error:
            fault = f"{path}: not a 4x4 matrix of numbers ({error}); restore the original"
        faults.append(fault)
    return matrices, faults


def _find_numbers(path: Path) -> list[int]:
    """The numbers in a file's name."""
    return [int(number) for number in re.findall(r"\d+", path.stem)]


def _parse_name(stem: str, place: int) -> tuple[str, int]:
    """The sequence and the index of a frame by its file's name; its place in the folder if the name has no number."""
    match = NUMBER.search(stem)
    if match is None:
        return "frames", place
    return stem[: match.start()].rstrip("-_.").removesuffix("frame").rstrip("-_.") or "frames", int(match[0])
