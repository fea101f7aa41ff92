"""Other ground truths of a scene: pseudo ground truth from files, and 7-Scenes' own poses moved to the colour camera.

7-Scenes' and 12-Scenes' original poses are those of the depth camera, from depth fusion. Brachmann et al. (ICCV 2021)
computed poses for the same images by structure from motion, and registered the original ones to the colour camera. The
same predictions have other errors under another truth, so that a report never mixes two.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes.images import read_gray
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene

__all__ = ["GroundTruth", "apply_ground_truth", "check_ground_truth"]

GroundTruth = Literal["original", "registered", "sfm"]
"""`original`: as the dataset has it. `registered`: moved to the colour camera. `sfm`: by structure from motion."""

FOLDERS = {"sfm": "sfm", "registered": "dslam"}
"""Folders of the pseudo ground truth's files; `dslam` has the original poses, registered to the colour camera."""

COLUMNS = "image qw qx qy qz tx ty tz focal"

DEPTH_TO_COLOUR = np.array(
    [[1, -0.0027, 0.0079, 0.0255], [0.0027, 1, 0.0082, -0.0001], [-0.0079, -0.0082, 1, -0.0021], [0, 0, 0, 1]]
)
"""T_depth_colour of 7-Scenes' Kinect, (4, 4): T_world_colour = T_world_depth @ T_depth_colour.

25.5 mm and 0.67 degrees, found by comparing the original with the registered poses. The rotation is rounded.
"""

log = logging.getLogger("lightning_pose")


class ListedPose(NamedTuple):
    """A pose of a file: camera-to-world, and the focal length in pixels."""

    position_m: np.ndarray
    quat_wxyz: np.ndarray
    focal: float


def check_ground_truth(truth: str, pgt: str | None) -> None:
    """Refuse settings that contradict each other.

    Raises:
        ConfigError: the truth is unknown, `sfm` has no folder, or `original` has one.
    """
    if truth not in get_args(GroundTruth):
        raise ConfigError(f"data.ground_truth is {truth!r}; give one of {', '.join(get_args(GroundTruth))}")
    if truth == "sfm" and pgt is None:
        raise ConfigError(
            "data.ground_truth is sfm, and its poses are not part of the dataset; give the folder of the pseudo ground "
            "truth as data.pgt, the one that holds sfm/7scenes/SCENE_train.txt"
        )
    if truth == "original" and pgt is not None:
        raise ConfigError(
            f"data.pgt is {pgt}, but data.ground_truth is original, which does not read it; set sfm or registered"
        )


def apply_ground_truth(scene: Scene, truth: GroundTruth, pgt: str | None = None) -> Scene:
    """Replace a scene's poses by those of another ground truth.

    Args:
        scene: with splits.
        truth: which ground truth.
        pgt: folder of the pseudo ground truth, with files `sfm/7scenes/SCENE_train.txt`, `..._test.txt` (`dslam` for
            `registered`, and `12scenes` for the other dataset), of lines `image qw qx qy qz tx ty tz focal`, poses
            world-to-camera. Without it, `registered` moves 7-Scenes' original poses by a constant transform.

    Returns:
        the scene with these poses, in the same splits. With files, frames get their focal length as intrinsics, and
        frames that they do not list are dropped with a warning.

    Raises:
        ConfigError: as `check_ground_truth`, or the scene has no such truth.
        DataError: files are missing or malformed, or list none of the scene's images.
    """
    check_ground_truth(truth, pgt)
    if truth == "original":
        return scene
    if scene.ground_truth != "original":
        raise ConfigError(
            f"data.ground_truth is {truth}, but the poses of {scene.root} are {scene.ground_truth}; "
            "set original to use them as they are"
        )
    if truth == "registered" and (pgt is None or not (Path(pgt).expanduser() / FOLDERS[truth]).is_dir()):
        return _move_to_colour_camera(scene)
    files = _find_files(scene, Path(pgt or "").expanduser() / FOLDERS[truth])
    listed = dict(pose for file in files for pose in _read_poses(file))
    return _replace_poses(scene, listed, truth, files)


def _move_to_colour_camera(scene: Scene) -> Scene:
    """7-Scenes with the constant transform between its cameras.

    Raises:
        ConfigError: it is another dataset.
    """
    if scene.format != "7scenes":
        raise ConfigError(
            f"data.ground_truth is registered, but {scene.root} is {scene.format}, and only 7-Scenes has a known "
            "transform between its cameras; give data.pgt, or set original"
        )
    U, _, Vt = np.linalg.svd(DEPTH_TO_COLOUR[:3, :3])
    turn = Rotation.from_matrix(U @ Vt)
    world_depth = Rotation.from_quat([frame.quat_wxyz for frame in scene.frames], scalar_first=True)
    moved = np.array([frame.position_m for frame in scene.frames]) + world_depth.apply(DEPTH_TO_COLOUR[:3, 3])
    quats = (world_depth * turn).as_quat(canonical=True, scalar_first=True)
    frames = (replace(f, position_m=p, quat_wxyz=q) for f, p, q in zip(scene.frames, moved, quats, strict=True))
    return replace(scene, frames=tuple(frames), ground_truth="registered")


def _find_files(scene: Scene, folder: Path) -> list[Path]:
    """The scene's files in a folder of datasets; scenes of 12-Scenes are named with the folder above, `apt1_kitchen`.

    Raises:
        DataError: there is none.
    """
    root = scene.root.resolve()
    names = root.name, f"{root.parent.name}_{root.name}"
    files = [
        path for name in names for split in ("train", "test") for path in sorted(folder.glob(f"*/{name}_{split}.txt"))
    ]
    if not files:
        raise DataError(
            f"{folder} has no file DATASET/{names[0]}_train.txt or DATASET/{names[1]}_train.txt; give the folder of "
            "the pseudo ground truth as data.pgt, and keep the names of the scenes' folders"
        )
    return files


def _read_poses(path: Path) -> Iterator[tuple[tuple[str, ...], ListedPose]]:
    """The parts of each image's name, without its extension, and its pose.

    Raises:
        DataError: the file is no text, or a line is malformed.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as text ({error}); restore the original") from error
    names, rows = [], []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        name, *items = line.rsplit(maxsplit=8)
        try:
            row = np.array(items, np.float64)
        except ValueError:
            row = np.empty(0)
        if len(row) != 8 or not np.isfinite(row).all() or abs(np.linalg.norm(row[:4]) - 1) > 0.1 or not row[7] > 0:
            raise DataError(f"{path}:{number}: expected `{COLUMNS}`, found `{line}`; correct the line")
        names.append(_split_name(Path(name.replace("\\", "/"))))
        rows.append(row)
    table = np.array(rows).reshape(-1, 8)
    world_cam = Rotation.from_quat(table[:, :4], scalar_first=True).inv()
    positions = -world_cam.apply(table[:, 4:7])
    quats = world_cam.as_quat(canonical=True, scalar_first=True)
    for name, position, quat, focal in zip(names, positions, quats, table[:, 7], strict=True):
        yield name, ListedPose(position, quat, float(focal))


def _split_name(path: Path) -> tuple[str, ...]:
    """`seq-01/frame-000000.color.png` as ("seq-01", "frame-000000.color"): jpg and png are one image."""
    return path.with_suffix("").parts


def _replace_poses(scene: Scene, listed: dict[tuple[str, ...], ListedPose], truth: str, files: list[Path]) -> Scene:
    """The scene with the listed poses, and without the frames that are not listed.

    Raises:
        DataError: no frame is listed.
    """
    names = [_split_name(frame.image.relative_to(scene.root)) for frame in scene.frames]
    poses = _match_names(names, listed)
    kept = np.array([pose is not None for pose in poses])
    if not kept.any():
        raise DataError(
            f"{files[0]} lists {len(listed)} images, such as {'/'.join(next(iter(listed), ('none',)))}, but none of "
            f"{scene.root}, such as {'/'.join(names[0])}; give the files of this scene"
        )
    if not kept.all():
        missing = scene.frames[int(np.flatnonzero(~kept)[0])].image
        log.warning(
            "%s: dropped %d of %d frames without a pose in %s, the first is %s",
            scene.root, int((~kept).sum()), len(kept), ", ".join(map(str, files)), missing,
        )  # fmt: skip
    centre = _find_centre(scene.frames[int(np.flatnonzero(kept)[0])])
    frames = tuple(
        _replace_pose(frame, pose, centre) for frame, pose in zip(scene.frames, poses, strict=True) if pose is not None
    )
    number = np.cumsum(kept) - 1
    splits = {split: number[indices[kept[indices]]] for split, indices in scene.splits.items()}
    return replace(scene, frames=frames, splits=splits, ground_truth=truth, trajectory=None)


def _match_names(names: list[tuple[str, ...]], listed: dict[tuple[str, ...], ListedPose]) -> list[ListedPose | None]:
    """The pose of each image: of the same name, or of the only name that ends as the image's does, or it with that."""
    if any(name in listed for name in names):
        return [listed.get(name) for name in names]
    by_end: dict[str, list[ListedPose]] = {}
    for name, pose in listed.items():
        by_end.setdefault(name[-1], []).append(pose)
    ends = [name[-1] for name in names]
    if len(set(ends)) < len(ends) or any(len(poses) > 1 for poses in by_end.values()):
        return [None] * len(names)
    return [by_end[end][0] if end in by_end else None for end in ends]


def _replace_pose(frame: Frame, pose: ListedPose, centre: tuple[float, float]) -> Frame:
    """The frame with another pose, and its focal length."""
    camera = frame.intrinsics
    cx, cy = (camera.cx, camera.cy) if camera is not None else centre
    intrinsics = Intrinsics(pose.focal, pose.focal, cx, cy)
    return replace(frame, position_m=pose.position_m, quat_wxyz=pose.quat_wxyz, intrinsics=intrinsics)


def _find_centre(frame: Frame) -> tuple[float, float]:
    """The principal point of a frame's camera; the image's centre where the format does not give it."""
    if frame.intrinsics is not None:
        return frame.intrinsics.cx, frame.intrinsics.cy
    height, width = read_gray(frame.image).shape
    return width / 2, height / 2
