"""Writes a synthetic room to disk as a 7-Scenes dataset: the default data of every config."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes.synthetic.render import Renderer, make_camera
from lightning_pose.scenes.synthetic.room import make_room, measure_room
from lightning_pose.scenes.synthetic.sessions import Session, make_session
from lightning_pose.scenes.synthetic.trajectory import Walk, is_test, make_visit, make_walks

__all__ = ["METADATA", "MIN_FRAMES", "RENDERER_VERSION", "divide_frames", "render_room"]

METADATA = "synthetic.json"
RENDERER_VERSION = 1
"""Raised whenever the same seed gives other images or poses."""

MIN_FRAMES = 6
SMALLEST, LARGEST = (64, 48), (1920, 1440)


def render_room(
    root: Path,
    seed: int = 0,
    frames: int = 300,
    size: tuple[int, int] = (320, 240),
    progress: Callable[[int, int], None] | None = None,
    sessions: int = 1,
) -> Path:
    """Render a textured room along hand-held trajectories, in 7-Scenes layout.

    With several sessions, each is a sequence of its own: an independent walk at another time, with other light,
    exposure and blur, some furniture moved, and some boxes gone. The last is the test split.

    The same arguments give the same bytes. The images are rendered into a hidden sibling folder that is
    renamed at the end, so `root` is either absent or complete, even if several processes render it at once.
    If `root` already holds the room with these arguments, it is returned unchanged.

    Args:
        root: folder to write.
        seed: number of the room; each has its own dimensions, surfaces, furniture, pictures and trajectories.
        frames: number of images, over all sequences.
        size: width and height of the images, in pixels.
        progress: called with the number of images written and the total, after each.
        sessions: how many visits share the frames; 1 writes several walks of one visit.

    Returns:
        root. It holds `seq-01`, ... with `frame-%06d.color.png` and `frame-%06d.pose.txt` (4x4
        camera-to-world, OpenCV axes, metres, z up), `TrainSplit.txt`, `TestSplit.txt`, and `synthetic.json`.

    Raises:
        ConfigError: seed, frames, size or sessions is out of range.
        DataError: root holds something else, or cannot be written.
    """
    _check_arguments(seed, frames, size, sessions)
    root = Path(root)
    metadata = {
        "seed": seed,
        "frames": frames,
        "size": list(size),
        "renderer_version": RENDERER_VERSION,
        "intrinsics": {name: getattr(make_camera(size), name) for name in ("fx", "fy", "cx", "cy")},
    }
    if sessions > 1:
        metadata["sessions"] = sessions
    if _holds_room(root, metadata):
        return root
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{root.name}-", dir=root.parent) as scratch:
            unfinished = Path(scratch) / root.name
            _write_room(unfinished, _plan_sequences(seed, frames, sessions), seed, size, progress)
            (unfinished / METADATA).write_text(json.dumps(metadata, indent=2) + "\n")
            try:
                unfinished.rename(root)
            except OSError:
                # Another process may have finished the same room first; its files are the same.
                if not _holds_room(root, metadata):
                    raise
    except OSError as error:
        raise DataError(f"cannot write the room to {root}: {error}; give a folder that can be written") from error
    return root


def divide_frames(frames: int) -> list[int]:
    """Frames per sequence: about 30 up to 300 frames, then ten longer ones, then more of 100."""
    count = max(3, min(10, frames // 30), -(-frames // 100))
    return [len(part) for part in np.array_split(np.arange(frames), count)]


def _check_arguments(seed: int, frames: int, size: tuple[int, int], sessions: int) -> None:
    """Raise a ConfigError if an argument of `render_room` is out of range."""
    if seed < 0:
        raise ConfigError(f"seed is {seed}; give a whole number of 0 or more")
    if frames < MIN_FRAMES:
        raise ConfigError(
            f"frames is {frames}, too few for two training and one test sequence; give {MIN_FRAMES} or more"
        )
    if not 1 <= sessions <= frames // 2:
        raise ConfigError(f"sessions is {sessions}; give 1 to {frames // 2}, so that each has 2 of the {frames} frames")
    if not (SMALLEST[0] <= size[0] <= LARGEST[0] and SMALLEST[1] <= size[1] <= LARGEST[1]):
        low, high = (f"{w}x{h}" for w, h in (SMALLEST, LARGEST))
        raise ConfigError(f"size is {size[0]}x{size[1]}; give a width and height from {low} to {high} pixels")


def _holds_room(root: Path, metadata: dict) -> bool:
    """Whether root holds the room of this metadata; False if root is absent or empty.

    Raises:
        DataError: root holds anything else.
    """
    if not root.exists() or (root.is_dir() and not any(root.iterdir())):
        return False
    remedy = "give another folder, or delete it first"
    try:
        found = json.loads((root / METADATA).read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{root} already holds something that is not a synthetic room; {remedy}") from error
    if found == metadata:
        return True
    other = ", ".join(f"{key} {found.get(key)}" for key in metadata if found.get(key) != metadata[key])
    raise DataError(f"{root} already holds another synthetic room ({other}); {remedy}")


@dataclass(frozen=True)
class _Sequence:
    """One sequence to render: the number of its visit, its walk, and whether it tests."""

    session: int
    walk: Walk
    held_out: bool


def _plan_sequences(seed: int, frames: int, sessions: int) -> list[_Sequence]:
    """The sequences of a room; arguments as for `render_room`."""
    size_m = measure_room(seed)
    if sessions == 1:
        walks = make_walks(seed, size_m, divide_frames(frames))
        return [_Sequence(0, walk, is_test(i)) for i, walk in enumerate(walks)]
    lengths = [len(part) for part in np.array_split(np.arange(frames), sessions)]
    return [_Sequence(i, make_visit(seed, size_m, i, length), i == sessions - 1) for i, length in enumerate(lengths)]


def _write_room(
    root: Path,
    sequences: list[_Sequence],
    seed: int,
    size: tuple[int, int],
    progress: Callable[[int, int], None] | None,
) -> None:
    """Write all files of the room but its metadata; arguments as for `render_room`."""
    root.mkdir()
    for name, held_out in (("TrainSplit.txt", False), ("TestSplit.txt", True)):
        lines = [f"sequence{i}\n" for i, sequence in enumerate(sequences, start=1) if sequence.held_out == held_out]
        (root / name).write_text("".join(lines))
    total, done = sum(sequence.walk.length for sequence in sequences), 0
    built: tuple[int, Renderer] | None = None
    # Threads are enough: OpenCV and numpy release the interpreter's lock, and threads need no copies of the room.
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        for i, sequence in enumerate(sequences):
            if built is None or built[0] != sequence.session:
                built = sequence.session, Renderer(make_room(seed, sequence.session).quads, make_camera(size), size)
            folder = root / f"seq-{i + 1:02d}"
            folder.mkdir()
            write = partial(_write_frame, built[1], make_session(seed, sequence.session), folder, sequence.walk)
            for _ in pool.map(partial(write, [seed, 2, i]), range(sequence.walk.length)):
                done += 1
                if progress is not None:
                    progress(done, total)


def _write_frame(renderer: Renderer, session: Session, folder: Path, walk: Walk, seed: list[int], frame: int) -> None:
    """Write image and pose of a walk's frame; `seed` is that of the sequence."""
    moments = frame + session.shutter * (np.arange(4) - 1.5) / 4
    image = renderer.render(np.array([walk.pose(moment) for moment in moments]))
    if session.defocus_px:
        image = cv2.GaussianBlur(image, (0, 0), session.defocus_px * image.shape[1] / 320)
    generators = np.random.default_rng([*seed, frame]), np.random.default_rng(seed)
    image = _add_sensor_effects(image * np.float32(session.exposure), *generators, frame)
    stem = folder / f"frame-{frame:06d}"
    ok, png = cv2.imencode(".png", image)
    if not ok:
        raise RuntimeError(f"OpenCV could not encode frame {frame}")
    Path(f"{stem}.color.png").write_bytes(png.tobytes())
    np.savetxt(f"{stem}.pose.txt", walk.pose(frame), fmt="%.9f")


def _add_sensor_effects(
    image: np.ndarray, frame_rng: np.random.Generator, sequence_rng: np.random.Generator, frame: int
) -> np.ndarray:
    """Add what a sensor adds: gain and white balance that change along the sequence, shot and read noise, 8 bits."""
    phase, period = sequence_rng.uniform(0, 2 * np.pi, 4), sequence_rng.uniform(40, 120, 4)
    wave = np.sin(phase + 2 * np.pi * frame / period)
    image = image * (1 + 0.08 * wave[0] + 0.02 * wave[1:]).astype(np.float32)
    deviation = np.sqrt(1.0 + 0.02 * image)
    image += deviation * frame_rng.standard_normal(image.shape, np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
