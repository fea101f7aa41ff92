"""Facts about a dataset, and its faults: unreadable images, copies across splits, poses that jump."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from lightning_pose.errors import ImageError
from lightning_pose.scenes.gaps import describe_gaps
from lightning_pose.scenes.images import ImageFacts, measure_image, read_bytes
from lightning_pose.scenes.scene import SPLITS, Scene

__all__ = [
    "Findings",
    "ImageFile",
    "SequenceFacts",
    "count_sequence_frames",
    "describe_scene",
    "inspect_images",
    "inspect_poses",
    "read_image_files",
]

JUMP = 20.0
"""A step longer than this many times the median is a jump; in real hand-held sequences none exceeds five times."""

JUMP_DEG = 30.0
"""A rotation is a jump if it reaches this many degrees and JUMP times the median."""

SHOWN = 5
"""How many findings of one kind are listed one by one; of the others only the number is given."""


@dataclass(frozen=True)
class Findings:
    """What is wrong with a dataset: errors make training or its results useless, warnings may be intended."""

    errors: list[str]
    warnings: list[str]


@dataclass(frozen=True)
class ImageFile:
    """An image file: digest of its bytes and facts if it can be decoded, otherwise what is wrong with it."""

    digest: bytes = b""
    facts: ImageFacts | None = None
    error: str = ""

    @property
    def size(self) -> str:
        """`WIDTHxHEIGHT`, empty if the image cannot be decoded."""
        return "" if self.facts is None else f"{self.facts.width}x{self.facts.height}"


class SequenceFacts(NamedTuple):
    """One sequence: its name, how many of its frames each split has, and the numbers of its first and last frame."""

    name: str
    counts: dict[str, int]
    first: int
    last: int


def read_image_files(scene: Scene) -> Iterator[ImageFile]:
    """Read the image of each frame, in the order of the frames, with several threads.

    Decoding and hashing release the interpreter's lock, so that threads are enough.
    """
    with ThreadPoolExecutor() as pool:
        yield from pool.map(_read_image_file, [frame.image for frame in scene.frames])


def describe_scene(scene: Scene, files: list[ImageFile]) -> dict[str, str]:
    """Facts about a scene by their names, both in words: format, splits, image sizes, camera, extent, motion.

    Args:
        scene: the dataset, of at least one frame.
        files: the image file of each of its frames.
    """
    sizes = {split: len(scene.splits[split]) for split in SPLITS}
    camera = scene.frames[0].intrinsics
    positions, quats = _stack_positions(scene), _stack_quats(scene)
    facts = {
        "format": f"{scene.format}, ground truth {scene.ground_truth}",
        f"split ({scene.split_source})": ", ".join(f"{split} {size}" for split, size in sizes.items()),
        "image size": _format_counts(Counter(file.size for file in files if file.size)) or "none can be read",
        "image depth": _format_counts(Counter(f"{file.facts.bits} bits" for file in files if file.facts)) or "unknown",
        "intrinsics": "unknown" if camera is None else f"f {camera.fx:g} {camera.fy:g}, c {camera.cx:g} {camera.cy:g}",
        "extent": " x ".join(f"{side:.2f}" for side in np.ptp(positions, axis=0)) + f" {scene.unit}",
    }
    step, angle_deg, _ = _measure_steps(scene)
    if len(step):
        facts["frame spacing"] = f"median {np.median(step):.3g} {scene.unit}, {np.median(angle_deg):.3g} deg"
    from_mean = _find_angle_deg(Rotation.from_quat(quats, scalar_first=True).mean().as_quat(scalar_first=True), quats)
    facts["rotation"] = f"up to {from_mean.max():.0f} deg from the mean, median {np.median(from_mean):.0f} deg"
    train, test = scene.splits["train"], scene.splits["test"]
    if len(train) and len(test):
        distance, nearest = KDTree(positions[train]).query(positions[test])
        angle_deg = _find_angle_deg(quats[test], quats[train[nearest]])
        facts["test to nearest training pose"] = (
            f"median {np.median(distance):.3g} {scene.unit}, {np.median(angle_deg):.3g} deg; "
            f"up to {distance.max():.3g} {scene.unit}"
        )
    return facts


def count_sequence_frames(scene: Scene) -> list[SequenceFacts]:
    """Count the frames of each sequence, split by split; sequences are in the scene's order."""
    split_of = _map_frames_to_splits(scene)
    members: dict[str, list[int]] = {}
    for i, frame in enumerate(scene.frames):
        members.setdefault(frame.sequence, []).append(i)
    facts = []
    for name, rows in members.items():
        counts = Counter(split_of[i] for i in rows)
        first, last = scene.frames[rows[0]].index, scene.frames[rows[-1]].index
        facts.append(SequenceFacts(name, {split: counts[split] for split in SPLITS}, first, last))
    return facts


def inspect_images(scene: Scene, files: list[ImageFile]) -> Findings:
    """Find unreadable images, copies of one image (above all in test and training alike), and images of mixed kinds.

    Args:
        scene: the dataset.
        files: the image file of each of its frames.
    """
    errors = [file.error for file in files if file.error]
    first: dict[bytes, int] = {}
    copies = [(i, first.setdefault(file.digest, i)) for i, file in enumerate(files) if file.digest]
    copies = [(i, original) for i, original in copies if i != original]
    split_of = _map_frames_to_splits(scene)
    leaks = [(i, j) for i, j in copies if (split_of[i] == "test") != (split_of[j] == "test")]
    warnings = []
    for pairs, complaint in (
        (copies, "images are copies of others (some cameras repeat frames)"),
        (
            leaks,
            "test images are also training or validation images, which makes errors look smaller than they are",
        ),
    ):
        if pairs:
            i, j = pairs[0]
            warnings.append(f"{len(pairs)} {complaint}: {scene.frames[i].image} is {scene.frames[j].image}")
    sizes = Counter(file.size for file in files if file.size)
    if len(sizes) > 1:
        warnings.append(f"images of {len(sizes)} sizes, {_format_counts(sizes)}; resize them unless the cameras differ")
    errors = _limit_findings(errors, "unreadable images")
    warnings += _describe_kinds(scene, [file.facts for file in files])
    blank = [i for i, file in enumerate(files) if file.facts is not None and file.facts.blank]
    if blank:
        text = f"{len(blank)} images have one value in all pixels, such as {scene.frames[blank[0]].image}; remove them"
        (errors if 2 * len(blank) > len(files) else warnings).append(text)
    return Findings(errors, warnings)


def _describe_kinds(scene: Scene, facts: list[ImageFacts | None]) -> list[str]:
    """Texts on images with an EXIF orientation, and of images of less than 16 bits in 16-bit files."""
    known = [(i, fact) for i, fact in enumerate(facts) if fact is not None]
    texts = []
    turned = Counter(f"orientation {fact.orientation}" for _, fact in known if fact.orientation != 1)
    if turned:
        first = next(i for i, fact in known if fact.orientation != 1)
        texts.append(
            f"{sum(turned.values())} of {len(facts)} images have an EXIF orientation ({_format_counts(turned)}), "
            f"such as {scene.frames[first].image}; it is ignored, because poses and intrinsics refer to the pixels as "
            "stored: check that yours do, and give new images likewise"
        )
    depths = Counter(f"{fact.bits} bits" for _, fact in known)
    if len(depths) > 1:
        texts.append(f"images of {len(depths)} depths, {_format_counts(depths)}; each is scaled to 8 bits by its own")
    return texts


def inspect_poses(scene: Scene) -> Findings:
    """Find jumps between neighbouring frames, a camera that never moves, and poses written where tracking was lost."""
    step, angle_deg, neighbours = _measure_steps(scene)
    if not len(step):
        return Findings([], [])
    warnings = [] if (gaps := describe_gaps(scene)) is None else [gaps]
    if not np.ptp(_stack_positions(scene), axis=0).any():
        where = f"all {len(scene.frames)} positions are {scene.frames[0].position_m}"
        return Findings([f"{where}; there is nothing to learn, check the pose files"], warnings)
    typical = float(np.median(step))
    far = (step > JUMP * typical) & (typical > 0)
    turned = angle_deg > max(JUMP * float(np.median(angle_deg)), JUMP_DEG)
    jumps = [
        f"{scene.frames[i].image} to {scene.frames[i + 1].image.name}: the pose jumps by {step[k]:.3g} {scene.unit} "
        f"and {angle_deg[k]:.3g} deg; check both poses"
        for k, i in enumerate(neighbours)
        if far[k] or turned[k]
    ]
    return Findings([], warnings + _limit_findings(jumps, "jumps") + _find_lost_poses(scene))


def _find_lost_poses(scene: Scene) -> list[str]:
    """A warning if frames after the start of their sequence have exactly the origin and no rotation."""
    identity = (_stack_positions(scene) == 0).all(axis=1) & (_stack_quats(scene) == [1, 0, 0, 0]).all(axis=1)
    started: set[str] = set()
    lost = []
    for frame, at_origin in zip(scene.frames, identity, strict=True):
        if at_origin and frame.sequence in started:
            lost.append(frame)
        elif not at_origin:
            started.add(frame.sequence)
    if len(lost) < 2:
        return []
    return [
        f"{len(lost)} poses are exactly at the origin without rotation, as some programs write where tracking was "
        f"lost, such as that of {lost[0].image}; remove these frames"
    ]


def _read_image_file(path: Path) -> ImageFile:
    """Read and decode an image file."""
    try:
        data = read_bytes(path)
        facts = measure_image(data, path)
    except ImageError as error:
        return ImageFile(error=str(error))
    return ImageFile(hashlib.blake2b(data, digest_size=16).digest(), facts)


def _measure_steps(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measure the motion from each frame to the next one of its sequence.

    Returns:
        distance and angle (degrees) of each step, divided by the difference of the frames' numbers, and the rows of
        the frames that the steps start from; each (S,).
    """
    sequences = np.array([frame.sequence for frame in scene.frames])
    neighbours = np.flatnonzero(sequences[1:] == sequences[:-1])
    positions, quats = _stack_positions(scene), _stack_quats(scene)
    gap = np.maximum(np.diff([frame.index for frame in scene.frames])[neighbours], 1)
    step = np.linalg.norm(positions[neighbours + 1] - positions[neighbours], axis=1)
    angle = _find_angle_deg(quats[neighbours], quats[neighbours + 1])
    return step / gap, angle / gap, neighbours


def _stack_positions(scene: Scene) -> np.ndarray:
    """Camera centres of all frames, (F, 3), in the scene's unit."""
    return np.array([frame.position_m for frame in scene.frames])


def _stack_quats(scene: Scene) -> np.ndarray:
    """Orientations of all frames, (F, 4) wxyz, camera-to-world."""
    return np.array([frame.quat_wxyz for frame in scene.frames])


def _find_angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between unit quaternions, in degrees: (N,) of (4,) or (N, 4) and (N, 4)."""
    apart, together = np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)
    # The arc cosine of the product would be inaccurate near zero.
    return np.degrees(4 * np.arctan2(np.minimum(apart, together), np.maximum(apart, together)))


def _map_frames_to_splits(scene: Scene) -> dict[int, str]:
    """Frame index to the name of its split."""
    return {int(i): split for split, indices in scene.splits.items() for i in indices}


def _limit_findings(texts: list[str], what: str) -> list[str]:
    """The first `SHOWN` texts, and the number of all if there are more."""
    more = [f"{len(texts)} {what} in all"] if len(texts) > SHOWN else []
    return texts[:SHOWN] + more


def _format_counts(sizes: Counter[str]) -> str:
    """The most frequent sizes in words, with their counts if there are several sizes."""
    return ", ".join(size if len(sizes) == 1 else f"{size} ({count})" for size, count in sizes.most_common(SHOWN))
