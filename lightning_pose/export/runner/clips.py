"""A trajectory from the clips of a video: each clip begins with the last frame of the clip before it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

__all__ = ["FrameFollower", "chain_clips"]


def chain_clips(
    frames: int,
    length: int,
    in_camera: bool,
    integrate: bool,
    locate: Callable[[slice], tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray]:
    """Poses of all frames in the axes of the first camera.

    Args:
        frames: of the video.
        length: frames of a clip.
        in_camera: whether a clip's positions are in the axes of its first camera, or of the world.
        integrate: whether a clip's poses are relative to the frame before, instead of to its first frame.
        locate: positions (T, 3) and quaternions (T, 4) of a clip.

    Returns:
        position_m (frames, 3) and quat_wxyz (frames, 4), float64.
    """
    positions, quats = [np.zeros(3)], [np.array([1.0, 0, 0, 0])]
    for start in range(0, max(1, frames - 1), length - 1):
        clip = locate(slice(start, min(start + length, frames))) if frames > 1 else (np.zeros((1, 3)), np.zeros((1, 4)))
        for position, quat in place_clip(positions[start], quats[start], *clip, in_camera, integrate):
            positions.append(position)
            quats.append(quat)
    return np.array(positions), np.array(quats)


class FrameFollower:
    """Places the frames of a live video as they come: each by the clip of the last frames, which it ends.

    Args:
        length: frames of a clip.
        in_camera: as for `chain_clips`.
        integrate: likewise.
        locate: positions (T, 3) and quaternions (T, 4) of a clip, from what is added.
    """

    def __init__(
        self,
        length: int,
        in_camera: bool,
        integrate: bool,
        locate: Callable[[list[np.ndarray]], tuple[np.ndarray, np.ndarray]],
    ) -> None:
        self.in_camera, self.integrate, self.locate = in_camera, integrate, locate
        self.frames: deque[np.ndarray] = deque(maxlen=length)
        self.poses: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=length)

    def add(self, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The position (3,) and quaternion (4,) of the next frame, in the axes of the first."""
        self.frames.append(frame)
        if len(self.frames) == 1:
            self.poses.append((np.zeros(3), np.array([1.0, 0, 0, 0])))
        else:
            first = self.poses[len(self.poses) - len(self.frames) + 1]
            *_, last = place_clip(*first, *self.locate(list(self.frames)), self.in_camera, self.integrate)
            self.poses.append(last)
        return self.poses[-1]


def place_clip(
    first_position: np.ndarray,
    first_quat: np.ndarray,
    position: np.ndarray,
    quat: np.ndarray,
    in_camera: bool,
    integrate: bool,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Poses of a clip's frames but the first, whose pose is known, from what a network says of all T."""
    moved, turned = np.zeros(3), np.array([1.0, 0, 0, 0])
    for i in range(1, len(position)):
        if integrate:
            moved = moved + rotate_by_quat(turned, position[i])
            turned = multiply_quats(turned, quat[i])
            turned = -turned if turned[0] < 0 else turned
        else:
            moved, turned = position[i], quat[i]
        placed = first_position + (rotate_by_quat(first_quat, moved) if in_camera else moved)
        yield placed, multiply_quats(first_quat, turned)


def multiply_quats(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The product of two quaternions (4,), wxyz, with unit length."""
    w = a[0] * b[0] - a[1:] @ b[1:]
    product = np.concatenate([[w], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])
    return product / np.linalg.norm(product)


def rotate_by_quat(quat: np.ndarray, point: np.ndarray) -> np.ndarray:
    """A point (3,) turned by a unit quaternion (4,), wxyz."""
    twice = 2 * np.cross(quat[1:], point)
    return point + quat[0] * twice + np.cross(quat[1:], twice)
