"""COLMAP models (Schoenberger and Frahm, CVPR 2016), binary or text: photos with poses and cameras."""

from __future__ import annotations

import json
import logging
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.errors import DataError
from lightning_pose.geometry.camera import CAMERA_MODELS
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.cameras import make_intrinsics
from lightning_pose.scenes.formats.image_files import ImageFinder, number_images
from lightning_pose.scenes.formats.poses import check_quats
from lightning_pose.scenes.formats.text_files import read_lines
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene

__all__ = ["FORMAT", "Colmap", "find_model"]

log = logging.getLogger("lightning_pose")

FOLDERS = ("", "sparse", "sparse/0", "colmap/sparse/0", "colmap/sparse", "dense/sparse", "model")
"""Where a model is looked for; the folder `sparse` may hold several, numbered from 0."""

MODEL_IDS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR",
)  # fmt: skip
"""COLMAP's camera models by their numbers in binary files."""

OTHER_PARAMETERS = {"SIMPLE_DIVISION": 4, "DIVISION": 5, "EUCM": 6, "EQUIRECTANGULAR": 2}
"""How many parameters the models have whose distortion is not read."""


class Colmap(SceneFormat):
    """`cameras` and `images`, `.bin` or `.txt`, in `sparse/0` or beside the photos, which are in `images`.

    A model's poses are world-to-camera quaternions wxyz and translations; here they are inverted. Their unit is
    arbitrary, unless `reconstruct` has written that it is metres. Each frame has its own camera, with the half pixel
    taken off by which COLMAP counts from the corner of the first pixel. A folder of photos is a sequence. Of several
    models, the one with the most photos is read.
    """

    name = "colmap"
    looks_for = "images.bin or images.txt, with cameras, in the folder or in sparse/0"

    def matches(self, root: Path) -> bool:
        return find_model(root) is not None

    def read(self, root: Path) -> Scene:
        model = find_model(root)
        if model is None:
            raise DataError(f"{root} holds no COLMAP model; give cameras.bin and images.bin in {root / 'sparse' / '0'}")
        models = _list_models(root)
        if len(models) > 1:
            log.warning("%s holds %d models; %s has the most photos and is read", root, len(models), model)
        path, rows = _read_images(model)
        cameras = _read_cameras(model)
        if not rows:
            raise DataError(f"{path} holds no photo; register the photos again")
        position_m, quats, faults = _invert_poses(path, rows)
        finder = ImageFinder(root)
        folders = [str(PurePosixPath(row.name).parent) for row in rows]
        index: dict[str, Iterator[int]] = {}
        for folder in dict.fromkeys(folders):
            index[folder] = iter(number_images([r.name for r, f in zip(rows, folders, strict=True) if f == folder]))
        name = root.resolve().name
        frames = []
        for i, row in enumerate(rows):
            if row.camera not in cameras:
                raise DataError(
                    f"{path}: {row.name} has camera {row.camera}, which the cameras file lacks; restore both"
                )
            frames.append(
                Frame(
                    _find_photo(finder, row.name),
                    position_m[i],
                    quats[i],
                    name if folders[i] == "." else f"{name}/{folders[i]}",
                    next(index[folders[i]]),
                    intrinsics=cameras[row.camera],
                )
            )
        usable, bad = keep_usable(frames, faults, path.name)
        return Scene(name, root, self.name, usable, unit=_read_unit(root), ground_truth="sfm", bad_frames=bad)


FORMAT = Colmap()


class ImageRow(NamedTuple):
    """A photo of a model: world-to-camera (4,) quaternion wxyz and (3,) translation, its camera's number, its file."""

    quat_wxyz: np.ndarray
    translation: np.ndarray
    camera: int
    name: str


def find_model(root: Path) -> Path | None:
    """The folder of the model with the most photos; None if there is none."""
    models = _list_models(root)
    if len(models) < 2:
        return next(iter(models), None)
    return max(models, key=lambda model: len(_read_images(model)[1]))


def _list_models(root: Path) -> list[Path]:
    """The folders that hold a model."""
    numbered = sorted(path for path in (root / "sparse").glob("[0-9]*") if path.is_dir())
    places = dict.fromkeys([*(root / folder for folder in FOLDERS), *numbered])
    return [place for place in places if _find_files(place) is not None]


def _find_files(model: Path) -> tuple[Path, Path] | None:
    """The cameras and the images file of a model; None if there is none."""
    for suffix in (".bin", ".txt"):
        cameras, images = model / f"cameras{suffix}", model / f"images{suffix}"
        if cameras.is_file() and images.is_file():
            return cameras, images
    return None


def _read_unit(root: Path) -> str:
    """`m` where `reconstruct` has made the scene metric; else `scene`, because a model's unit is arbitrary."""
    try:
        return "m" if json.loads((root / "reconstruction.json").read_text(encoding="utf-8"))["unit"] == "m" else "scene"
    except (OSError, ValueError, KeyError, TypeError):
        return "scene"


def _find_photo(finder: ImageFinder, listed: str) -> Path:
    """The file of a photo: below the folder `images`, or below the scene's folder."""
    found = finder.find(f"images/{listed}")
    return found if found.is_file() else finder.find(listed)


def _invert_poses(path: Path, rows: Sequence[ImageRow]) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """(N, 3) camera centres, (N, 4) camera-to-world quaternions wxyz, and what is wrong with each photo."""
    quats = np.array([row.quat_wxyz for row in rows])
    translation = np.array([row.translation for row in rows])
    translation, quats, found = check_quats(translation, quats, scalar_first=True)
    rotation = Rotation.from_quat(quats, scalar_first=True).inv()
    faults = [wrong and f"{path}: {row.name}: {wrong}" for row, wrong in zip(rows, found, strict=True)]
    return -rotation.apply(translation), rotation.as_quat(canonical=True, scalar_first=True), faults


def _read_cameras(model: Path) -> dict[int, Intrinsics | None]:
    """The cameras of a model by number; None for one whose distortion is not read, with a warning."""
    files = _find_files(model)
    assert files is not None
    path = files[0]
    cameras: dict[int, Intrinsics | None] = {}
    for number, kind, width, height, values in _list_cameras(path):
        if kind in CAMERA_MODELS:
            cameras[number] = make_intrinsics(str(path), kind, width, height, values)
        else:
            log.warning(
                "%s: camera %d is of model %s, whose distortion is not read; undistort the photos", path, number, kind
            )
            cameras[number] = None
    return cameras


def _list_cameras(path: Path) -> Iterator[tuple[int, str, int, int, Sequence[float]]]:
    """Number, model, width, height and parameters of each camera of a file."""
    if path.suffix == ".txt":
        for number, line in read_lines(path):
            try:
                camera, kind, width, height, *values = line.split()
                yield int(camera), kind.upper(), int(width), int(height), [float(value) for value in values]
            except ValueError:
                raise DataError(
                    f"{path}:{number}: expected `CAMERA_ID MODEL WIDTH HEIGHT PARAMS...`, found `{line[:200]}`"
                ) from None
        return
    reader = BinaryReader(path)
    for _ in range(*reader.read("<Q")):
        number, kind, width, height = reader.read("<iiQQ")
        if not 0 <= kind < len(MODEL_IDS):
            raise DataError(f"{path}: camera {number} has the unknown model {kind}; convert the model to text")
        model = MODEL_IDS[kind]
        count = len(CAMERA_MODELS[model].split()) if model in CAMERA_MODELS else OTHER_PARAMETERS[model]
        yield number, model, width, height, reader.read(f"<{count}d")


def _read_images(model: Path) -> tuple[Path, list[ImageRow]]:
    """The images file of a model and its photos, by name."""
    files = _find_files(model)
    assert files is not None
    path = files[1]
    rows = _read_images_text(path) if path.suffix == ".txt" else _read_images_binary(path)
    return path, sorted(rows, key=lambda row: row.name)


def _read_images_text(path: Path) -> list[ImageRow]:
    """The photos of `images.txt`: a line each, followed by a line of its points, which may be empty."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    start = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), len(lines))
    rows = []
    for number in range(start, len(lines), 2):
        line = lines[number]
        if not line.strip():
            continue
        try:
            words = line.split(maxsplit=9)
            numbers = np.array(words[1:8], dtype=np.float64)
            rows.append(ImageRow(numbers[:4], numbers[4:7], int(words[8]), words[9].strip()))
        except (ValueError, IndexError):
            raise DataError(
                f"{path}:{number + 1}: expected `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME` and then a line of "
                f"points, found `{line[:200]}`; correct the line"
            ) from None
    return rows


def _read_images_binary(path: Path) -> list[ImageRow]:
    """The photos of `images.bin`; their points are skipped."""
    reader = BinaryReader(path)
    rows = []
    for _ in range(*reader.read("<Q")):
        _, *numbers, camera = reader.read("<i7di")
        name = reader.read_text()
        reader.skip(24 * reader.read("<Q")[0])
        rows.append(ImageRow(np.array(numbers[:4]), np.array(numbers[4:]), camera, name))
    return rows


class BinaryReader:
    """Reads numbers and names from a binary file, one after the other."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.place = path, path.read_bytes(), 0

    def read(self, layout: str) -> tuple:
        """The next numbers, by `struct`'s layout.

        Raises:
            DataError: the file ends before them.
        """
        try:
            values = struct.unpack_from(layout, self.data, self.place)
        except struct.error:
            raise self._fail() from None
        self.place += struct.calcsize(layout)
        return values

    def read_text(self) -> str:
        """The next text, which a zero byte ends."""
        end = self.data.find(b"\0", self.place)
        if end < 0:
            raise self._fail()
        text = self.data[self.place : end].decode("utf-8", errors="replace")
        self.place = end + 1
        return text

    def skip(self, count: int) -> None:
        """Leave out bytes."""
        self.place += count
        if self.place > len(self.data):
            raise self._fail()

    def _fail(self) -> DataError:
        return DataError(f"{self.path} ends at byte {len(self.data)}, in the middle of an entry; copy it again")
