"""EuRoC MAV (Burri et al., IJRR 2016): images by nanoseconds, poses of the body, and the camera's place on it."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from lightning_pose.errors import DataError
from lightning_pose.geometry.interpolation import interpolate_poses
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.image_files import ImageFinder
from lightning_pose.scenes.formats.poses import check_quats
from lightning_pose.scenes.formats.text_files import read_lines, read_table, read_text
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene, Trajectory

__all__ = ["FORMAT", "Euroc"]

log = logging.getLogger("lightning_pose")

TRUTHS = ("state_groundtruth_estimate0", "mocap0")
"""Folders with poses of the body."""

COLUMNS = "timestamp tx ty tz qw qx qy qz"
MAX_GAP_S = 0.1
"""A longer time between two poses is a hole, in which images have no pose."""


class Euroc(SceneFormat):
    """`mav0/cam0/data.csv` with `nanoseconds,file`, `mav0/cam0/sensor.yaml`, and poses of the body over time.

    Poses are read from `mav0/state_groundtruth_estimate0/data.csv` (or `mocap0`), body-to-world with the
    quaternion wxyz, and interpolated at the times of the images. `sensor.yaml` gives the camera's place on the body
    (`T_BS`), its `intrinsics`, `distortion_coefficients` and `resolution`. Images outside the poses' times are dropped
    with a count. The folder may be the recording's or its `mav0`.
    """

    name = "euroc"
    looks_for = "mav0/cam0/data.csv and mav0/state_groundtruth_estimate0/data.csv"

    def matches(self, root: Path) -> bool:
        folder = _find_recording(root)
        return (folder / "cam0" / "data.csv").is_file() and _find_truth(folder) is not None

    def read(self, root: Path) -> Scene:
        folder = _find_recording(root)
        truth = _find_truth(folder)
        if truth is None:
            raise DataError(f"{folder} has no poses; add {TRUTHS[0]}/data.csv")
        times_ns, images = _read_images(folder / "cam0" / "data.csv")
        T_body_cam, intrinsics = _read_sensor(folder / "cam0" / "sensor.yaml")
        table = read_table(truth, COLUMNS)
        position_m, quats, found = check_quats(table.values[:, 1:4], table.values[:, 4:], scalar_first=True)
        sound = np.array(
            [not fault and not wrong for fault, wrong in zip(table.faults, found, strict=True)], dtype=bool
        )
        if not sound.any():
            raise DataError(f"{truth} holds no usable pose; its columns are `{COLUMNS}`, restore the original")
        start = times_ns[0]
        pose_s = (table.values[sound, 0] - start) / 1e9
        turns = Rotation.from_quat(quats[sound], scalar_first=True)
        trajectory = Trajectory(
            table.values[sound, 0] / 1e9,
            position_m[sound] + turns.apply(T_body_cam[:3, 3]),
            (turns * Rotation.from_matrix(T_body_cam[:3, :3])).as_quat(canonical=True, scalar_first=True),
        )
        centres, cam_quats = interpolate_poses(
            pose_s, trajectory.positions_m, trajectory.quats_wxyz, (times_ns - start) / 1e9, MAX_GAP_S
        )
        posed = np.flatnonzero(np.isfinite(centres[:, 0]))
        if not len(posed):
            raise DataError(f"{folder}: no image lies within the times of {truth}; bring both to one clock")
        if len(posed) < len(images):
            log.warning(
                "%s: dropped %d of %d images, no pose at their time", root, len(images) - len(posed), len(images)
            )
        name = folder.resolve().parent.name if folder.resolve().name == "mav0" else root.resolve().name
        frames = [
            Frame(images[i], centres[i], cam_quats[i], name, int(i), float(times_ns[i] / 1e9), intrinsics)
            for i in posed
        ]
        usable, bad = keep_usable(frames, [""] * len(frames), "cam0/data.csv")
        return Scene(name, root, self.name, usable, bad_frames=bad, trajectory=trajectory)


FORMAT = Euroc()


def _find_recording(root: Path) -> Path:
    """The folder `mav0`, or the folder itself."""
    return root / "mav0" if (root / "mav0").is_dir() else root


def _find_truth(folder: Path) -> Path | None:
    """The file with the poses, None if there is none."""
    return next((path for name in TRUTHS if (path := folder / name / "data.csv").is_file()), None)


def _read_images(path: Path) -> tuple[np.ndarray, list[Path]]:
    """(N,) nanoseconds, ascending, and N images."""
    finder = ImageFinder(path.parent)
    rows = []
    for number, line in read_lines(path):
        stamp, _, name = line.partition(",")
        if not stamp.strip().isdecimal() or not name.strip():
            raise DataError(f"{path}:{number}: expected `nanoseconds,file`, found `{line[:200]}`; correct the line")
        listed = name.strip()
        rows.append((int(stamp), finder.find(f"data/{listed}")))
    if not rows:
        raise DataError(f"{path} lists no image; restore the original")
    rows.sort(key=lambda row: row[0])
    return np.array([row[0] for row in rows], dtype=np.int64), [row[1] for row in rows]


def _read_sensor(path: Path) -> tuple[np.ndarray, Intrinsics]:
    """The (4, 4) pose of the camera on the body, and the camera.

    Raises:
        DataError: the file is missing or lacks one of them.
    """
    text = "\n".join(line for line in read_text(path).splitlines() if not line.startswith("%YAML"))
    try:
        content = yaml.safe_load(text)
        T_body_cam = np.array(content["T_BS"]["data"], dtype=np.float64).reshape(4, 4)
        fx, fy, cx, cy = (float(value) for value in content["intrinsics"])
        width, height = (int(value) for value in content["resolution"])
        lens = tuple(float(value) for value in content.get("distortion_coefficients") or ())
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{path} has no T_BS, intrinsics and resolution of a camera ({type(error).__name__}: {error}); "
            "restore the original"
        ) from None
    fisheye = str(content.get("distortion_model", "")).startswith(("equi", "fish"))
    return T_body_cam, Intrinsics(fx, fy, cx, cy, (width, height), lens if any(lens) else (), fisheye and any(lens))
