"""What is wrong with a dataset: images that cannot be read, poses that leap, splits that overlap."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightning_pose.errors import ImageError
from lightning_pose.scenes.images import decode_image, read_bytes
from lightning_pose.scenes.scene import Scene

__all__ = [
    "Findings",
    "ImageFile",
    "find_angle_deg",
    "format_counts",
    "inspect_images",
    "inspect_poses",
    "map_frames_to_splits",
    "measure_steps",
    "read_image_file",
    "stack_positions",
    "stack_quats",
]

JUMP = 20.0
"""A step this many times the median is a jump; hand-held real sequences stay below five times."""

JUMP_DEG = 30.0
"""A turn must reach this many degrees, and JUMP times the median, to count as a jump."""

SHOWN = 5
"""Findings of one kind that are printed one by one."""


@dataclass(frozen=True)
class Findings:
    """What is wrong: errors spoil a training or its numbers, warnings may be meant."""

    errors: list[str]
    warnings: list[str]


@dataclass(frozen=True)
class ImageFile:
    """One image as it lies on disk: its size if it can be decoded, otherwise what is wrong with it."""

    digest: bytes = b""
    size: str = ""
    error: str = ""


def inspect_images(scene: Scene, files: list[ImageFile]) -> Findings:
    """Unreadable images, copies of one image, above all between test and training, and mixed sizes.

    Args:
        scene: the dataset.
        files: what lies on disk for each of its frames.
    """
    errors = [file.error for file in files if file.error]
    first: dict[bytes, int] = {}
    copies = [(i, first.setdefault(file.digest, i)) for i, file in enumerate(files) if file.digest]
    copies = [(i, original) for i, original in copies if i != original]
    split_of = map_frames_to_splits(scene)
    leaks = [(i, j) for i, j in copies if (split_of[i] == "test") != (split_of[j] == "test")]
    warnings = []
    for pairs, complaint in (
        (copies, "images are copies of others (a camera that repeats frames does that)"),
        (
            leaks,
            "test images are also training or validation images, which flatters the result",
        ),
    ):
        if pairs:
            i, j = pairs[0]
            warnings.append(f"{len(pairs)} {complaint}: {scene.frames[i].image} is {scene.frames[j].image}")
    sizes = Counter(file.size for file in files if file.size)
    if len(sizes) > 1:
        warnings.append(f"images of {len(sizes)} sizes, {format_counts(sizes)}; resize them unless the cameras differ")
    return Findings(limit_findings(errors, "unreadable images"), warnings)


def inspect_poses(scene: Scene) -> Findings:
    """Jumps between neighbouring frames, and a camera that never moves."""
    step, angle_deg, neighbours = measure_steps(scene)
    if not len(step):
        return Findings([], [])
    if not np.ptp(stack_positions(scene), axis=0).any():
        where = f"all {len(scene.frames)} positions are {scene.frames[0].position_m}"
        return Findings([f"{where}; there is nothing to learn, check the pose files"], [])
    typical = float(np.median(step))
    far = (step > JUMP * typical) & (typical > 0)
    turned = angle_deg > max(JUMP * float(np.median(angle_deg)), JUMP_DEG)
    jumps = [
        f"{scene.frames[i].image} to {scene.frames[i + 1].image.name}: the pose jumps by {step[k]:.3g} {scene.unit} "
        f"and {angle_deg[k]:.3g} deg; check both poses"
        for k, i in enumerate(neighbours)
        if far[k] or turned[k]
    ]
    return Findings([], limit_findings(jumps, "jumps"))


def read_image_file(path: Path) -> ImageFile:
    """Digest and size of an image file, or what is wrong with it."""
    try:
        data = read_bytes(path)
        height, width = decode_image(data, path, color=False).shape
    except ImageError as error:
        return ImageFile(error=str(error))
    return ImageFile(hashlib.blake2b(data, digest_size=16).digest(), f"{width}x{height}")


def measure_steps(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance and angle (degrees) from each frame to the next of its sequence, per index, and the frames."""
    sequences = np.array([frame.sequence for frame in scene.frames])
    neighbours = np.flatnonzero(sequences[1:] == sequences[:-1])
    positions, quats = stack_positions(scene), stack_quats(scene)
    gap = np.maximum(np.diff([frame.index for frame in scene.frames])[neighbours], 1)
    step = np.linalg.norm(positions[neighbours + 1] - positions[neighbours], axis=1)
    angle = find_angle_deg(quats[neighbours], quats[neighbours + 1])
    return step / gap, angle / gap, neighbours


def stack_positions(scene: Scene) -> np.ndarray:
    """Camera centres of all frames, (F, 3), in the scene's unit."""
    return np.array([frame.position_m for frame in scene.frames])


def stack_quats(scene: Scene) -> np.ndarray:
    """Orientations of all frames, (F, 4) wxyz, camera-to-world."""
    return np.array([frame.quat_wxyz for frame in scene.frames])


def find_angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between unit quaternions, in degrees: (N,) of (4,) or (N, 4) and (N, 4)."""
    apart, together = np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)
    # Not the arc cosine of the product: that has no digits left near zero.
    return np.degrees(4 * np.arctan2(np.minimum(apart, together), np.maximum(apart, together)))


def map_frames_to_splits(scene: Scene) -> dict[int, str]:
    """Frame index to the name of its split."""
    return {int(i): split for split, indices in scene.splits.items() for i in indices}


def limit_findings(texts: list[str], what: str) -> list[str]:
    """The first few, and how many there are in all."""
    more = [f"{len(texts)} {what} in all"] if len(texts) > SHOWN else []
    return texts[:SHOWN] + more


def format_counts(sizes: Counter[str]) -> str:
    """The most frequent sizes in words, with their counts where there are several."""
    return ", ".join(size if len(sizes) == 1 else f"{size} ({count})" for size, count in sizes.most_common(SHOWN))
