"""Tiny datasets on disk for tests: empty image files and poses that can be computed by hand."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from lightning_pose.scenes.trajectory_files import write_tum

__all__ = ["QUARTER_TURN_Z", "REAL_DATA", "make_image", "make_turned_jpeg", "write_recording", "write_seven_scenes"]

REAL_DATA = Path(__file__).parents[3] / "shared" / "data"
"""Real datasets beside the checkout, for those who have them; tests that need them are skipped without."""

QUARTER_TURN_Z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
"""90 degrees about z: the quaternion wxyz (sqrt(1/2), 0, 0, sqrt(1/2))."""


def make_image(path: Path) -> Path:
    """An empty file: the formats do not decode images."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def make_turned_jpeg(pixels: np.ndarray, orientation: int, order: str = "<") -> bytes:
    """A JPEG file with an EXIF orientation, in either byte order.

    Args:
        pixels: (H, W) or (H, W, 3) BGR, uint8.
        orientation: 1 to 8.
        order: `<` or `>`.
    """
    data = cv2.imencode(".jpg", pixels)[1].tobytes()
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(f"{order}I", 8)
    tiff = head + struct.pack(f"{order}HHHIHHI", 1, 0x0112, 3, 1, orientation, 0, 0)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff + data[2:]


def write_seven_scenes(root: Path, train: Mapping[int, int], test: Mapping[int, int], suffix: str = "png") -> Path:
    """A folder in 7-Scenes layout; frame i of sequence s stands at (i, s, 0), turned a quarter about z.

    Args:
        root: folder to write.
        train: sequence number -> number of frames.
        test: likewise.
        suffix: of the images.
    """
    root.mkdir(parents=True, exist_ok=True)
    for file, sequences in (("TrainSplit.txt", train), ("TestSplit.txt", test)):
        (root / file).write_text("".join(f"sequence{number}\n" for number in sequences))
        for number, count in sequences.items():
            for i in range(count):
                stem = root / f"seq-{number:02d}" / f"frame-{i:06d}"
                make_image(stem.with_suffix(f".color.{suffix}"))
                T_world_cam = np.eye(4)
                T_world_cam[:3, :3] = QUARTER_TURN_Z
                T_world_cam[:3, 3] = i, number, 0
                np.savetxt(stem.with_suffix(".pose.txt"), T_world_cam, fmt="%.7e")
    return root


def write_recording(root: Path, source: Path, sequence: int) -> str:
    """One sequence of a scene in 7-Scenes layout, as a folder in TUM layout."""
    images = sorted((source / f"seq-{sequence:02d}").glob("*.png"))
    (root / "rgb").mkdir(parents=True)
    matrices = [np.loadtxt(str(image).replace("color.png", "pose.txt")) for image in images]
    lines = []
    for number, image in enumerate(images):
        shutil.copy(image, root / "rgb" / f"{number}.png")
        lines.append(f"{1000 + number / 10:.6f} rgb/{number}.png\n")
    (root / "rgb.txt").write_text("".join(lines))
    turns = [np.arctan2(T[0, 2], T[0, 0]) for T in matrices]
    quats = np.array([[np.cos(turn / 2), 0, np.sin(turn / 2), 0] for turn in turns])
    times = [1000 + number / 10 for number in range(len(images))]
    write_tum(root / "groundtruth.txt", times, np.array([T[:3, 3] for T in matrices]), quats)
    return str(root)
