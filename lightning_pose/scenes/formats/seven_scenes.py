"""Microsoft 7-Scenes (Shotton et al., CVPR 2013), and the synthetic room, which is written in the same layout."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.frame_folders import has_posed_frames, read_frame_folder
from lightning_pose.scenes.formats.text_files import find_file, list_files, read_lines, read_text
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene

__all__ = ["FORMAT", "SevenScenes"]

log = logging.getLogger("lightning_pose")

SPLIT_FILES = {"train": "TrainSplit.txt", "test": "TestSplit.txt"}
COLOUR = Intrinsics(fx=525.0, fy=525.0, cx=320.0, cy=240.0, size=(640, 480))
"""Nominal values of the Kinect's colour camera, in pixels."""


class SevenScenes(SceneFormat):
    """`TrainSplit.txt` and `TestSplit.txt` list sequences as `sequenceN`, the folder `seq-NN`.

    Each sequence holds `frame-NNNNNN.color.png` (or jpg) and `frame-NNNNNN.pose.txt`, the 4x4
    camera-to-world matrix in metres, OpenCV axes. Without both split files, every `seq-NN` is read, or the folder
    itself if it holds the frames. A rendered room has a file `synthetic.json` with its camera as `intrinsics`: `fx`,
    `fy`, `cx`, `cy`; real scenes get the Kinect's nominal values.
    """

    name = "7scenes"
    looks_for = "TrainSplit.txt and TestSplit.txt, or seq-NN/frame-NNNNNN.pose.txt"

    def matches(self, root: Path) -> bool:
        if all(find_file(root, file).is_file() for file in SPLIT_FILES.values()):
            return True
        is_12_scenes = find_file(root, "split.txt").is_file()
        return not is_12_scenes and (
            has_posed_frames(root) or any(map(has_posed_frames, _find_sequences(root).values()))
        )

    def read(self, root: Path) -> Scene:
        folders = _find_sequences(root)
        split_of = _read_split_files(root, folders)
        if split_of:
            _warn_of_unlisted_sequences(root, folders, split_of)
            read = {name: folders[name] for name in split_of}
        else:
            read = folders or {root.resolve().name: root}
        intrinsics = _read_intrinsics(root)
        frames, faults = [], []
        for name, folder in read.items():
            listed = read_frame_folder(folder)
            faults += listed.faults
            frames += [
                Frame(image, position, quat, name, index, intrinsics=intrinsics)
                for index, image, position, quat in zip(*listed[:4], strict=True)
            ]
        usable, bad = keep_usable(frames, faults)
        splits = {
            split: np.array([i for i, frame in enumerate(usable) if split_of[frame.sequence] == split], dtype=int)
            for split in (SPLIT_FILES if split_of else ())
        }
        ground_truth = "synthetic" if (root / "synthetic.json").is_file() else "original"
        name = root.resolve().name
        return Scene(name, root, self.name, usable, splits, ground_truth=ground_truth, bad_frames=bad)


FORMAT = SevenScenes()


def _find_sequences(root: Path) -> dict[str, Path]:
    """Folders of the sequences, by the name `seq-NN` that 7-Scenes gives them."""
    found = {}
    for path in list_files(root) if root.is_dir() else []:
        match = re.fullmatch(r"(?:seq|sequence)[-_]?(\d{1,9})", path.name, re.IGNORECASE)
        if match and path.is_dir():
            inner = path / path.name  # some programs unpack seq-01.zip into seq-01/seq-01
            found.setdefault(f"seq-{int(match[1]):02d}", inner if inner.is_dir() else path)
    return found


def _read_split_files(root: Path, folders: Mapping[str, Path]) -> dict[str, str]:
    """The split of each listed sequence, by its name `seq-NN`; empty without split files."""
    files = {split: find_file(root, file) for split, file in SPLIT_FILES.items()}
    if not any(file.is_file() for file in files.values()) and (folders or has_posed_frames(root)):
        return {}
    split_of: dict[str, str] = {}
    for split, file in files.items():
        lines = read_lines(file)
        if not lines:
            raise DataError(f"{file} is empty; list the {split} sequences in it as `sequenceN`")
        for number, line in lines:
            place = f"{file}:{number}"
            match = re.fullmatch(r"sequence\s*(\d{1,9})|seq-?(\d{1,9})", line, re.IGNORECASE)
            if match is None:
                raise DataError(f"{place}: expected `sequenceN`, found `{line[:200]}`; correct the line")
            name = f"seq-{int(match[1] or match[2]):02d}"
            if split_of.get(name, split) != split:
                raise DataError(f"{place}: `{line}` is also in {SPLIT_FILES['train']}; take it out of one")
            if name not in folders:
                raise DataError(
                    f"{place}: `{line}` is listed, but {root / name} is missing; unzip {name}.zip there, "
                    "or take the line out"
                )
            split_of[name] = split
    return split_of


def _warn_of_unlisted_sequences(root: Path, folders: Mapping[str, Path], split_of: Mapping[str, str]) -> None:
    """Log a warning that names the sequences that have frames and are in no split file."""
    left = [name for name, folder in folders.items() if name not in split_of and has_posed_frames(folder)]
    if left:
        files = " nor in ".join(SPLIT_FILES.values())
        log.warning("%s: %s have frames but are neither in %s; they are not used", root, ", ".join(left), files)


def _read_intrinsics(root: Path) -> Intrinsics:
    """Read the camera of a rendered room; of any other folder it is that of 7-Scenes."""
    path = root / "synthetic.json"
    if not path.is_file():
        return COLOUR
    try:
        camera = json.loads(read_text(path))["intrinsics"]
        numbers = {name: float(camera[name]) for name in ("fx", "fy", "cx", "cy")}
        if not (np.isfinite(list(numbers.values())).all() and min(numbers["fx"], numbers["fy"]) > 0):
            raise ValueError(f"found {numbers}")
        return Intrinsics(numbers["fx"], numbers["fy"], numbers["cx"], numbers["cy"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(f"{path}: no `intrinsics` of fx, fy, cx, cy ({error!r}); render the room again") from error
