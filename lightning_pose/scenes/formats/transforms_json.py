"""`transforms.json`, as NeRF (Mildenhall et al., ECCV 2020), instant-ngp and nerfstudio write it."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.cameras import make_intrinsics
from lightning_pose.scenes.formats.colmap import find_model
from lightning_pose.scenes.formats.image_files import ImageFinder, is_file, number_images
from lightning_pose.scenes.formats.poses import check_matrices
from lightning_pose.scenes.formats.text_files import read_text
from lightning_pose.scenes.images import measure_image, read_bytes
from lightning_pose.scenes.scene import SPLITS, Frame, Intrinsics, Scene

__all__ = ["FORMAT", "TransformsJson"]

log = logging.getLogger("lightning_pose")

FILE = "transforms.json"
SPLIT_FILES = {f"transforms_{split}.json": split for split in SPLITS}
"""One file a split, as NeRF's synthetic scenes have them."""

CAMERA_KEYS = ("w", "h", "fl_x", "fl_y", "camera_angle_x", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""The numbers of a camera that a frame or the file may have."""

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""NeRF's camera looks along -z with y up."""


class TransformsJson(SceneFormat):
    """`transforms.json` with `frames`, each a `file_path` and a 4x4 camera-to-world `transform_matrix`.

    The camera's axes are OpenGL's in the file. The camera (`fl_x`, `fl_y`, `cx`, `cy`, `k1` ..., `w`, `h`, or
    `camera_angle_x`) stands in the file, or in each frame; its principal point is counted from the corner of the first
    pixel. The unit is arbitrary. Frames whose image is missing are dropped with a count, as other programs do. A split
    is read from `train_filenames`, `test_filenames` and `val_filenames`, or from `transforms_train.json`,
    `transforms_test.json` and `transforms_val.json`. A folder that also holds a COLMAP model is read as that.
    """

    name = "transforms_json"
    looks_for = "transforms.json, or transforms_train.json and transforms_test.json"

    def matches(self, root: Path) -> bool:
        return bool(_list_files(root)) and find_model(root) is None

    def read(self, root: Path) -> Scene:
        files = _list_files(root)
        if not files:
            raise DataError(f"{root} has no {FILE}; give the folder that holds it")
        entries = [entry for file, split in files for entry in _read_entries(file, split)]
        finder = ImageFinder(root)
        images = [finder.find(entry.listed) for entry in entries]
        present = [i for i in range(len(entries)) if is_file(images[i])]
        if not present:
            raise DataError(
                f"{root}: none of the {len(entries)} images of {files[0][0].name} is there, such as {images[0]}; "
                "copy the images beside the file"
            )
        if len(present) < len(entries):
            log.warning(
                "%s: dropped %d of %d frames, their images are missing",
                files[0][0], len(entries) - len(present), len(entries),
            )  # fmt: skip
        matrices = np.array([entries[i].T_world_cam for i in present]) @ OPENGL_TO_OPENCV
        position_m, quats, found = check_matrices(matrices)
        faults = [wrong and f"{entries[i].place}: {wrong}" for i, wrong in zip(present, found, strict=True)]
        name = root.resolve().name
        size = _measure_size(entries, images[present[0]])
        numbers = number_images([entries[i].listed for i in present])
        frames = [
            Frame(
                images[i], position_m[row], quats[row], name, numbers[row],
                intrinsics=_read_camera(entries[i].place, entries[i].settings, size),
            )
            for row, i in enumerate(present)
        ]  # fmt: skip
        usable, bad = keep_usable(frames, faults)
        splits = _make_official_splits(usable, {images[i]: entries[i].split for i in present})
        return Scene(name, root, self.name, usable, splits, unit="scene", ground_truth="sfm", bad_frames=bad)


FORMAT = TransformsJson()


class Entry(NamedTuple):
    """A frame of the file: its place there, its image as listed, its pose, its settings, its split or an empty text."""

    place: str
    listed: str
    T_world_cam: np.ndarray
    settings: Mapping[str, Any]
    split: str


def _list_files(root: Path) -> list[tuple[Path, str]]:
    """The files of a folder, each with the split that its name says, or an empty text."""
    if (root / FILE).is_file():
        return [(root / FILE, "")]
    files = [(root / name, split) for name, split in SPLIT_FILES.items() if (root / name).is_file()]
    return files if {"train", "test"} <= {split for _, split in files} else []


def _read_entries(path: Path, split: str) -> list[Entry]:
    """The frames of a file.

    Raises:
        DataError: it is no JSON of that form, or lists no frame.
    """
    try:
        content = json.loads(read_text(path))
        frames = list(content["frames"])
        listed = {Path(name).as_posix(): part for part in SPLITS for name in content.get(f"{part}_filenames") or []}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path} is no {FILE} ({type(error).__name__}: {error}); restore the original") from None
    shared = {key: value for key, value in content.items() if key != "frames"}
    entries = []
    for number, frame in enumerate(frames):
        place = f"{path}: frame {number}"
        try:
            name, matrix = Path(frame["file_path"]).as_posix(), np.array(frame["transform_matrix"], dtype=np.float64)
            matrix = np.vstack([matrix, [0, 0, 0, 1]]) if matrix.shape == (3, 4) else matrix
            if matrix.shape != (4, 4):
                raise ValueError(f"the matrix has the shape {matrix.shape}")
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"{place}: expected file_path and a 4x4 transform_matrix ({type(error).__name__}: {error}); correct it"
            ) from None
        entries.append(Entry(place, name, matrix, {**shared, **frame}, split or listed.get(name, "")))
    if not entries:
        raise DataError(f"{path} lists no frame; give one with `frames`")
    return entries


def _measure_size(entries: list[Entry], image: Path) -> tuple[int, int]:
    """Width and height of an image, for the frames whose settings do not have them; 0 if all have them."""
    if all({"w", "h"} <= entry.settings.keys() for entry in entries):
        return 0, 0
    facts = measure_image(read_bytes(image), image)
    return facts.width, facts.height


def _read_camera(place: str, settings: Mapping[str, Any], size: tuple[int, int]) -> Intrinsics | None:
    """The camera of a frame, whose images have this width and height; None if the file does not give it."""
    if not {"fl_x", "fl_y", "camera_angle_x"} & settings.keys():
        return None
    try:
        values = {key: float(settings[key]) for key in CAMERA_KEYS if settings.get(key) is not None}
    except (TypeError, ValueError):
        raise DataError(f"{place}: a number of the camera is no number; correct it") from None
    width, height = (values["w"], values["h"]) if {"w", "h"} <= values.keys() else size
    fx = values.get("fl_x") or values.get("fl_y") or width / 2 / np.tan(values["camera_angle_x"] / 2)
    fy = values.get("fl_y") or fx
    fisheye = bool(settings.get("is_fisheye")) or "FISHEYE" in str(settings.get("camera_model", "")).upper()
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    lens = [values.get(name, 0.0) for name in names]
    model = "OPENCV_FISHEYE" if fisheye else "FULL_OPENCV" if any(lens[4:]) else "OPENCV" if any(lens) else "PINHOLE"
    parameters = [fx, fy, values.get("cx", width / 2), values.get("cy", height / 2)]
    parameters += [] if model == "PINHOLE" else lens[:4] if model == "OPENCV" else lens
    return make_intrinsics(place, model, int(width), int(height), parameters)


def _make_official_splits(frames: tuple[Frame, ...], split_of: Mapping[Path, str]) -> dict[str, np.ndarray]:
    """Training and test frames, if the files name both; the frames that they validate on are trained on as well."""
    names = np.array([split_of[frame.image] for frame in frames])
    if not {"train", "test"} <= set(names):
        return {}
    return {"train": np.flatnonzero(np.isin(names, ["train", "val"])), "test": np.flatnonzero(names == "test")}
