"""The base class of formats on disk, and what they share: unusable frames are left out, and named together."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np

from lightning_pose.scenes.formats.image_files import is_file, make_natural_key
from lightning_pose.scenes.scene import Frame, Scene

__all__ = ["SceneFormat", "describe_bad_frames", "keep_usable"]

NAMED_FRAMES = 3
"""How many unusable frames a message names; of the others it says only how many there are."""

LOST_STEP = 10
"""Tracking is taken for lost where the step to a pose that is the origin itself is so many times the usual step."""

LONGEST_FAULT = 600
"""Characters of a text about one frame; names and numbers may have thousands."""


class SceneFormat(ABC):
    """Reads one layout of posed images; no other code depends on how it is stored on disk.

    To add a format, put one module into this package with a subclass that has

    - `name`: what a user writes as `format`;
    - `looks_for`: the files by which the format is recognised, in words, for messages;
    - `matches`: whether a folder is of this format, by the presence of those files, quickly;
    - `read`: the scene, with camera-to-world poses in OpenCV axes; `splits` has `train` and `test` if the format has
      an official split and is empty otherwise (`load_scene` makes the missing splits);

    and an instance of it named `FORMAT`, which `known_formats` finds. `text_files` reads files of numbers, `poses`
    checks poses, `image_files` finds images.
    """

    name: ClassVar[str]
    looks_for: ClassVar[str]

    @abstractmethod
    def matches(self, root: Path) -> bool:
        """Whether the folder has the files of this format."""

    @abstractmethod
    def read(self, root: Path) -> Scene:
        """Read every frame, without decoding an image; `keep_usable` puts the unusable ones into `bad_frames`.

        Raises:
            DataError: a file is missing or malformed as a whole; the message names it.
        """


def keep_usable(
    frames: Sequence[Frame], faults: Sequence[str], listed_in: str | None = None
) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Sort frames as a `Scene` needs them, and part those that can be used from the others.

    Args:
        frames: all frames that the dataset lists.
        faults: what is wrong with each of them, beginning with the file and the line; empty if nothing is.
        listed_in: the file that lists the images, if they may be missing.

    Returns:
        `frames` and `bad_frames` of the scene. Frames are sorted by sequence, and by index within each sequence.
    """
    usable, bad = [], []
    order = sorted(range(len(frames)), key=lambda i: (make_natural_key(frames[i].sequence), frames[i].index))
    lost = _find_lost_frames(frames, [i for i in order if not faults[i]])
    for i in order:
        fault, image = faults[i], frames[i].image
        if i in lost:
            fault = f"{image} has the pose 0 0 0 with no rotation, far from its neighbours: tracking was lost there"
        if not fault and listed_in is not None and not is_file(image):
            fault = f"{image} is missing, listed in {listed_in}; unpack it there or remove it from the list"
        if fault:
            bad.append(fault)
        else:
            usable.append(frames[i])
    return tuple(usable), tuple(bad)


def _find_lost_frames(frames: Sequence[Frame], order: Sequence[int]) -> set[int]:
    """Frames whose pose is the identity although the frames around them are elsewhere.

    Trackers write the identity where they have lost the camera. A sequence may begin with it, and stay there.

    Args:
        frames: all frames.
        order: those with a sound pose, by sequence and index.
    """
    at_origin = [not frames[i].position_m.any() and not frames[i].quat_wxyz[1:].any() for i in order]
    if not any(at_origin):
        return set()
    position = np.array([frames[i].position_m for i in order])
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    within = np.array([frames[i].sequence == frames[j].sequence for i, j in pairwise(order)], bool)
    moved = steps[within & (steps > 0)]
    jump = within & (steps > LOST_STEP * np.median(moved)) if len(moved) else within & False
    lost: set[int] = set()
    entered = False  # by a jump to the origin, in the same sequence
    for row, i in enumerate(order):
        if row and (jump[row - 1] or not within[row - 1]):
            entered = bool(jump[row - 1])
        if at_origin[row] and entered:
            lost.add(i)
        elif not at_origin[row]:
            entered = False
    return lost


def describe_bad_frames(scene: Scene) -> str:
    """How many of a scene's frames cannot be used, and the first of them."""
    bad = scene.bad_frames
    more = [f"and {len(bad) - NAMED_FRAMES} more"] if len(bad) > NAMED_FRAMES else []
    named = "; ".join([*map(_shorten_fault, bad[:NAMED_FRAMES]), *more])
    return f"{len(bad)} of {len(scene.frames) + len(bad)} frames cannot be used: {named}"


def _shorten_fault(text: str) -> str:
    """A text without its middle if it is too long to read."""
    return text if len(text) <= LONGEST_FAULT else f"{text[: LONGEST_FAULT // 2]}...{text[-LONGEST_FAULT // 2 :]}"
