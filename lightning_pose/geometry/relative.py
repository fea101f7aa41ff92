"""Poses relative to a clip's first frame (thesis, eq. 6.1), and trajectories chained from them."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.quaternions import compose_pose, quat_conjugate, quat_multiply, quat_normalize, quat_rotate

__all__ = ["Chain", "RelativeFrame", "absolute_poses", "chain_steps", "check_relative_frame", "relative_poses"]

RelativeFrame = Literal["camera", "world"]
"""The axes of a relative position: those of the clip's first camera, or those of the world, as in eq. 6.1."""


def check_relative_frame(name: str) -> None:
    """Raise an error unless the name is a `RelativeFrame`.

    Raises:
        ConfigError: it is neither `camera` nor `world`.

    >>> check_relative_frame("camera")
    """
    if name not in get_args(RelativeFrame):
        raise ConfigError(f"relative_frame is {name!r}; give one of {', '.join(get_args(RelativeFrame))}")


def relative_poses(
    position_m: Float[Tensor, "*batch t 3"], quat_wxyz: Float[Tensor, "*batch t 4"], frame: RelativeFrame = "camera"
) -> tuple[Float[Tensor, "*batch t 3"], Float[Tensor, "*batch t 4"]]:
    """Poses of a clip's t frames relative to the pose of its first frame (thesis, eq. 6.1).

    Args:
        position_m: camera centres in the world.
        quat_wxyz: unit, camera-to-world.
        frame: `world` gives `x_n - x_0` in world axes, as eq. 6.1 does. `camera` rotates it into the axes of the
            first camera, because images of a new scene do not show where the world's axes point.

    Returns:
        relative positions, and `q_0^-1 q_n` with w >= 0; zero and the identity for the first frame.

    >>> half_turn_about_z = torch.tensor([[0.0, 0, 0, 1]]).expand(2, 4)
    >>> position_m, quat_wxyz = relative_poses(torch.tensor([[1.0, 0, 0], [3.0, 0, 0]]), half_turn_about_z)
    >>> position_m
    tensor([[ 0.,  0.,  0.],
            [-2.,  0.,  0.]])
    """
    first_position, inverse = position_m[..., :1, :], quat_conjugate(quat_wxyz[..., :1, :])
    moved = position_m - first_position
    turned = quat_multiply(inverse, quat_wxyz)
    turned = torch.where(turned[..., :1] < 0, -turned, turned)
    return (quat_rotate(inverse, moved) if frame == "camera" else moved), turned


def absolute_poses(
    position_m: Float[Tensor, "*batch t 3"],
    quat_wxyz: Float[Tensor, "*batch t 4"],
    first_position_m: Float[Tensor, "*batch 3"],
    first_quat_wxyz: Float[Tensor, "*batch 4"],
    frame: RelativeFrame = "camera",
) -> tuple[Float[Tensor, "*batch t 3"], Float[Tensor, "*batch t 4"]]:
    """Poses in the world from relative poses and the first frame's pose; the inverse of `relative_poses`.

    Args:
        position_m: relative.
        quat_wxyz: relative, unit.
        first_position_m: in the world.
        first_quat_wxyz: in the world, unit.
        frame: as for `relative_poses`.

    >>> identity = torch.tensor([1.0, 0, 0, 0])
    >>> absolute_poses(torch.tensor([[2.0, 0, 0]]), identity[None], torch.tensor([0.0, 1, 0]), identity)[0]
    tensor([[2., 1., 0.]])
    """
    first_position, first_quat = first_position_m.unsqueeze(-2), first_quat_wxyz.unsqueeze(-2)
    moved = quat_rotate(first_quat, position_m) if frame == "camera" else position_m
    return first_position + moved, quat_multiply(first_quat, quat_wxyz)


def chain_steps(
    position_m: Float[Tensor, "batch steps 3"], quat_wxyz: Float[Tensor, "batch steps 4"]
) -> tuple[Float[Tensor, "batch steps+1 3"], Float[Tensor, "batch steps+1 4"]]:
    """Compose steps, each the pose of a camera relative to the camera before it.

    Args:
        position_m: each in the axes of the camera before.
        quat_wxyz: unit.

    Returns:
        positions in the axes of the first camera, and quaternions with w >= 0, both relative to the first camera. The
        first of the steps + 1 poses is that camera's own: zero and the identity.

    >>> one_metre_ahead = torch.tensor([0.0, 0, 1]).expand(1, 2, 3)
    >>> chain_steps(one_metre_ahead, torch.tensor([1.0, 0, 0, 0]).expand(1, 2, 4))[0]
    tensor([[[0., 0., 0.],
             [0., 0., 1.],
             [0., 0., 2.]]])
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
    """Builds a trajectory of any length from overlapping clips, one clip at a time, as a live camera gives them.

    Each clip must begin at a frame that an earlier clip contained; its other frames are placed relative to that one. A
    frame keeps the first pose that it gets, so that poses already returned do not change.

    Args:
        frame: in which axes the clips' positions are, as for `relative_poses`.
        position_m: of the first frame of all; the origin if not given.
        quat_wxyz: of the first frame of all; the identity if not given.

    >>> chain, identity = Chain(), torch.tensor([1.0, 0, 0, 0]).expand(2, 4)
    >>> chain.add([0, 1], torch.tensor([[0.0, 0, 0], [0, 0, 1]]), identity)
    [0, 1]
    >>> chain.add([1, 2], torch.tensor([[0.0, 0, 0], [0, 0, 5]]), identity)
    [2]
    >>> chain.trajectory()[1][:, 2].tolist()
    [0.0, 1.0, 6.0]
    """

    def __init__(
        self,
        frame: RelativeFrame = "camera",
        position_m: Float[Tensor, " 3"] | None = None,
        quat_wxyz: Float[Tensor, " 4"] | None = None,
    ) -> None:
        check_relative_frame(frame)
        self.frame: RelativeFrame = frame
        self._start = (
            torch.zeros(3, dtype=torch.float64) if position_m is None else position_m.double().cpu(),
            torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64) if quat_wxyz is None else quat_wxyz.double().cpu(),
        )
        self.poses: dict[int, tuple[Tensor, Tensor]] = {}
        """Frame number to position_m (3,) and quat_wxyz (4,), float64, in the order in which they were added."""

    def add(self, numbers: list[int], position_m: Float[Tensor, "t 3"], quat_wxyz: Float[Tensor, "t 4"]) -> list[int]:
        """Add one clip of t frames.

        Args:
            numbers: t frame numbers.
            position_m: relative to the clip's first frame.
            quat_wxyz: relative to the clip's first frame.

        Returns:
            the numbers of the frames that had no pose before.

        Raises:
            ConfigError: the clip begins at a frame that no earlier clip contained.
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

    def trajectory(self) -> tuple[list[int], Float[Tensor, "m 3"], Float[Tensor, "m 4"]]:
        """Frame numbers in ascending order, and their positions and quaternions, float64."""
        numbers = sorted(self.poses)
        positions, quats = zip(*(self.poses[number] for number in numbers), strict=True)
        return numbers, torch.stack(positions), torch.stack(quats)
