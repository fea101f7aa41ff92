"""Poses relative to a clip's first frame (thesis, eq. 6.1), and trajectories chained from them."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.quaternions import compose_pose, quat_conjugate, quat_multiply, quat_normalize, quat_rotate

__all__ = ["Chain", "RelativeFrame", "absolute_poses", "chain_steps", "check_relative_frame", "relative_poses"]

RelativeFrame = Literal["camera", "world"]
"""The axes of a relative position: those of the clip's first camera, or the world's as eq. 6.1 has it."""


def check_relative_frame(name: str) -> None:
    """Refuse any other name.

    Raises:
        ConfigError: it is neither `camera` nor `world`.
    """
    if name not in get_args(RelativeFrame):
        raise ConfigError(f"relative_frame is {name!r}; give one of {', '.join(get_args(RelativeFrame))}")


def relative_poses(position_m: Tensor, quat_wxyz: Tensor, frame: RelativeFrame = "camera") -> tuple[Tensor, Tensor]:
    """Every pose of a clip relative to its first: eq. 6.1, whose world axes a network cannot know in a new scene.

    Args:
        position_m: (..., T, 3) camera centres in the world.
        quat_wxyz: (..., T, 4), unit, camera-to-world.
        frame: `world` keeps `x_n - x_0` in world axes, as eq. 6.1 does; `camera` turns it into those of the first
            camera.

    Returns:
        position_m (..., T, 3) and quat_wxyz (..., T, 4), `q_0^-1 q_n` with w >= 0; zero and the identity for the
        first frame.
    """
    first_position, inverse = position_m[..., :1, :], quat_conjugate(quat_wxyz[..., :1, :])
    moved = position_m - first_position
    turned = quat_multiply(inverse, quat_wxyz)
    turned = torch.where(turned[..., :1] < 0, -turned, turned)
    return (quat_rotate(inverse, moved) if frame == "camera" else moved), turned


def absolute_poses(
    position_m: Tensor,
    quat_wxyz: Tensor,
    first_position_m: Tensor,
    first_quat_wxyz: Tensor,
    frame: RelativeFrame = "camera",
) -> tuple[Tensor, Tensor]:
    """The inverse of `relative_poses`, from the first frame's pose in the world.

    Args:
        position_m: (..., T, 3) relative.
        quat_wxyz: (..., T, 4) relative, unit.
        first_position_m: (..., 3) in the world.
        first_quat_wxyz: (..., 4) in the world, unit.
        frame: as for `relative_poses`.

    Returns:
        position_m (..., T, 3) and quat_wxyz (..., T, 4) in the world.
    """
    first_position, first_quat = first_position_m.unsqueeze(-2), first_quat_wxyz.unsqueeze(-2)
    moved = quat_rotate(first_quat, position_m) if frame == "camera" else position_m
    return first_position + moved, quat_multiply(first_quat, quat_wxyz)


def chain_steps(position_m: Tensor, quat_wxyz: Tensor) -> tuple[Tensor, Tensor]:
    """Compose steps, each the pose of a camera seen from the one before it.

    Args:
        position_m: (B, T - 1, 3), each in the axes of the camera before.
        quat_wxyz: (B, T - 1, 4), unit.

    Returns:
        position_m (B, T, 3) in the axes of the first camera and quat_wxyz (B, T, 4) with w >= 0, both relative to
        the first camera, which comes first.
    """
    position = position_m.new_zeros(len(position_m), 3)
    quat = quat_wxyz.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(quat_wxyz), 4)
    positions, quats = [position], [quat]
    for step in range(position_m.shape[1]):
        position, quat = compose_pose(position, quat, position_m[:, step], quat_wxyz[:, step])
        quat = quat_normalize(torch.where(quat[:, :1] < 0, -quat, quat))
        positions.append(position)
        quats.append(quat)
    return torch.stack(positions, dim=1), torch.stack(quats, dim=1)


class Chain:
    """A trajectory of any length from overlapping clips, as they come: causal, so that it serves a live camera.

    Each clip must begin at a frame whose pose is known by then; its other frames are placed relative to that one. A
    frame keeps the first pose it was given, so that nothing already answered changes.

    Args:
        frame: in which axes the clips' positions are, as for `relative_poses`.
        position_m: (3,) of the first frame of all; the origin if not given.
        quat_wxyz: (4,) of the first frame of all; the identity if not given.
    """

    def __init__(
        self, frame: RelativeFrame = "camera", position_m: Tensor | None = None, quat_wxyz: Tensor | None = None
    ) -> None:
        check_relative_frame(frame)
        self.frame: RelativeFrame = frame
        self._start = (
            torch.zeros(3, dtype=torch.float64) if position_m is None else position_m.double().cpu(),
            torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64) if quat_wxyz is None else quat_wxyz.double().cpu(),
        )
        self.poses: dict[int, tuple[Tensor, Tensor]] = {}
        """Frame number to position_m (3,) and quat_wxyz (4,), float64, in the order they became known."""

    def add(self, numbers: list[int], position_m: Tensor, quat_wxyz: Tensor) -> list[int]:
        """Take in one clip.

        Args:
            numbers: T frame numbers.
            position_m: (T, 3) relative to the clip's first frame.
            quat_wxyz: (T, 4) relative to the clip's first frame.

        Returns:
            the numbers whose poses are new.

        Raises:
            ConfigError: the clip begins at a frame that no earlier clip reached.
        """
        if not self.poses:
            self.poses[numbers[0]] = self._start
            new = [numbers[0]]
        elif numbers[0] in self.poses:
            new = []
        else:
            raise ConfigError(
                f"a clip begins at frame {numbers[0]}, but only {min(self.poses)} to {max(self.poses)} are known; "
                "let clips overlap by one frame at least"
            )
        relative = position_m.double().cpu(), quat_normalize(quat_wxyz.double().cpu())
        positions, quats = absolute_poses(*relative, *self.poses[numbers[0]], self.frame)
        for number, position, quat in zip(numbers, positions, quats, strict=True):
            if number not in self.poses:
                self.poses[number] = position, quat_normalize(quat)
                new.append(number)
        return new

    def trajectory(self) -> tuple[list[int], Tensor, Tensor]:
        """Frame numbers ascending, and their positions (M, 3) and quaternions (M, 4), float64."""
        numbers = sorted(self.poses)
        positions, quats = zip(*(self.poses[number] for number in numbers), strict=True)
        return numbers, torch.stack(positions), torch.stack(quats)
