"""Microsoft 7-Scenes (Shotton et al., CVPR 2013), and the synthetic room, which is written in the same layout."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, convert_matrices, read_lines, sort_frames
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene

__all__ = ["FORMAT", "SevenScenes"]

SPLIT_FILES = {"train": "TrainSplit.txt", "test": "TestSplit.txt"}
COLOUR = Intrinsics(fx=525.0, fy=525.0, cx=320.0, cy=240.0, size=(640, 480))
"""Nominal values of the Kinect's colour camera, in pixels."""
FRAME_FILE = re.compile(r"frame-(\d+)\.(?:(color\.(?:png|jpe?g))|(pose\.txt))")


class SevenScenes(SceneFormat):
    """`TrainSplit.txt` and `TestSplit.txt` list sequences as `sequenceN`, the folder `seq-NN`.

    Each sequence holds `frame-NNNNNN.color.png` (or jpg) and `frame-NNNNNN.pose.txt`, the 4x4
    camera-to-world matrix in metres, OpenCV axes. A rendered room has a file `synthetic.json` with
    its camera as `intrinsics`: `fx`, `fy`, `cx`, `cy`; real scenes get the Kinect's nominal values.
    """

    name = "7scenes"
    looks_for = "TrainSplit.txt and TestSplit.txt"

    def matches(self, root: Path) -> bool:
        return all((root / file).is_file() for file in SPLIT_FILES.values())

    def read(self, root: Path) -> Scene:
        split_of = _read_split_files(root)
        intrinsics = _read_intrinsics(root)
        frames = sort_frames(frame for sequence in split_of for frame in _read_sequence(root / sequence, intrinsics))
        splits = {
            split: np.array([i for i, frame in enumerate(frames) if split_of[frame.sequence] == split])
            for split in SPLIT_FILES
        }
        ground_truth = "synthetic" if (root / "synthetic.json").is_file() else "original"
        return Scene(root.resolve().name, root, self.name, frames, splits, ground_truth=ground_truth)


FORMAT = SevenScenes()


def _read_split_files(root: Path) -> dict[str, str]:
    """The split of each listed sequence, by the name of its folder."""
    split_of: dict[str, str] = {}
    for split, file in SPLIT_FILES.items():
        lines = read_lines(root / file)
        if not lines:
            raise DataError(f"{root / file} is empty; list the {split} sequences in it as `sequenceN`")
        for number, line in lines:
            place = f"{root / file}:{number}"
            match = re.fullmatch(r"sequence\s*(\d+)", line)
            if match is None:
                raise DataError(f"{place}: expected `sequenceN`, found `{line}`; correct the line")
            folder = f"seq-{int(match[1]):02d}"
            if split_of.get(folder, split) != split:
                raise DataError(f"{place}: `{line}` is also in {SPLIT_FILES['train']}; take it out of one")
            if not (root / folder).is_dir():
                raise DataError(
                    f"{place}: `{line}` is listed, but {root / folder} is missing; unzip {folder}.zip there, "
                    "or take the line out"
                )
            split_of[folder] = split
    return split_of


def _read_sequence(folder: Path, intrinsics: Intrinsics) -> list[Frame]:
    """Read the frames of one sequence, in no particular order."""
    images: dict[int, Path] = {}
    poses: dict[int, Path] = {}
    for path in folder.iterdir():
        if match := FRAME_FILE.fullmatch(path.name):
            (images if match[2] else poses)[int(match[1])] = path
    if not images:
        raise DataError(f"{folder} has no frame-NNNNNN.color.png or .jpg; unpack the images into it")
    for index in sorted(images.keys() ^ poses.keys()):
        if index in images:
            raise DataError(f"{images[index]} has no .pose.txt beside it; add it or drop the image")
        raise DataError(f"{poses[index]} has no image beside it; add it or drop the pose")
    where = [str(poses[index]) for index in images]
    positions, quats = convert_matrices(np.stack([_read_matrix(poses[i]) for i in images]), where)
    return [
        Frame(path, position, quat, folder.name, index, intrinsics=intrinsics)
        for (index, path), position, quat in zip(images.items(), positions, quats, strict=True)
    ]


def _read_matrix(path: Path) -> np.ndarray:
    """Read a pose file, (4, 4) float64."""
    try:
        # np.loadtxt is forty times slower, and a scene has thousands of these files.
        return np.array(path.read_text().split(), dtype=np.float64).reshape(4, 4)
    except ValueError as error:
        raise DataError(f"{path}: not a 4x4 matrix of numbers ({error}); restore the original") from error


def _read_intrinsics(root: Path) -> Intrinsics:
    """Read the camera of a rendered room; of any other folder it is that of 7-Scenes."""
    path = root / "synthetic.json"
    if not path.is_file():
        return COLOUR
    try:
        camera = json.loads(path.read_text())["intrinsics"]
        fx, fy, cx, cy = (float(camera[name]) for name in ("fx", "fy", "cx", "cy"))
        return Intrinsics(fx, fy, cx, cy)
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: no `intrinsics` of fx, fy, cx, cy ({error!r}); render the room again") from error
