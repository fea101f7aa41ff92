"""GivenPoses: from poses in a map whose frames were moved to poses as the dataset gives them, and back."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.mapping.point_map import PointMap

__all__ = ["GivenPoses"]

KERNEL = (0.05, 5.0)
"""How far training frames lend their offset to an answer: in median depths of the map's points, and degrees."""

AROUND = 15
"""Frames before and after each over which the drift of the given poses hardly changes, while the camera's turn does."""


class GivenPoses:
    """By how much the training frames of a map were moved, lent to poses near them.

    Args:
        point_map: the map; at least one training frame.
        without: numbers of training frames that lend nothing.

    Attributes:
        kept: (K,) int64, numbers of the frames that do.
        turn_sd: root mean square of what a camera turned while its rows were read, radians in one unit of normalised
            y, of each component; 0 for a global shutter.
    """

    def __init__(self, point_map: PointMap, without: np.ndarray | None = None) -> None:
        self.map = point_map
        self.kept = np.setdiff1d(np.arange(len(point_map.position)), [] if without is None else without)
        back = np.swapaxes(point_map.rotation, 1, 2)[self.kept]
        self._turn_back = Rotation.from_matrix(back @ point_map.given_rotation[self.kept]).as_rotvec()
        moved = point_map.given_position[self.kept] - point_map.position[self.kept]
        self._move_back = np.einsum("fij,fj->fi", back, moved)
        self._adjusted = bool(np.abs(self._turn_back).max() > 1e-12 or np.abs(self._move_back).max() > 1e-12)
        turns = point_map.turns[self.kept]
        self.turn_sd = float(np.sqrt((turns**2).mean()))
        self._by_turn = np.zeros((3, 6))
        if self.turn_sd > 0:
            moved_back = np.concatenate([self._turn_back, self._move_back], axis=1)
            self._by_turn = np.linalg.lstsq(_subtract_mean(turns), _subtract_mean(moved_back), rcond=None)[0]
            self._turn_back = self._turn_back - turns @ self._by_turn[:, :3]
            self._move_back = self._move_back - turns @ self._by_turn[:, 3:]
        self._kernel = KERNEL[0] * point_map.measure_depth()

    def carry_back(self, pose: CameraPose, turn: np.ndarray | None = None) -> CameraPose:
        """The pose that the dataset would give a camera at `pose` of the map: by what near training frames were moved.

        The offset of an answer is the mean of theirs, in the axes of the camera, weighted by a Gaussian of their
        distance and angle to it. What depends on how the camera `turn`ed (3,), because the clocks of images and poses
        differ or because the given poses take the shutter for a global one, is a linear function of it.
        """
        if not self._adjusted:
            return pose
        offset = self._mean_offset(pose, self.map.rotation, self.map.position)
        if turn is not None:
            offset = offset + turn @ self._by_turn
        back = Rotation.from_rotvec(offset[:3]).as_matrix()
        return CameraPose(pose.rotation @ back, pose.position + pose.rotation @ offset[3:])

    def carry_forward(self, pose: CameraPose) -> CameraPose:
        """Where the map would put a camera at a pose that the dataset gives: the other way round."""
        if not self._adjusted:
            return pose
        offset = self._mean_offset(pose, self.map.given_rotation, self.map.given_position)
        rotation = pose.rotation @ Rotation.from_rotvec(-offset[:3]).as_matrix()
        return CameraPose(rotation, pose.position - rotation @ offset[3:])

    def _mean_offset(self, pose: CameraPose, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        """(6,) rotation vector and movement, in a camera's axes, from the map to given poses, of near frames."""
        away = np.linalg.norm(position[self.kept] - pose.position, axis=1) / self._kernel
        cosine = (np.einsum("fij,ij->f", rotation[self.kept], pose.rotation) - 1) / 2
        turned = np.degrees(np.arccos(np.clip(cosine, -1, 1))) / KERNEL[1]
        squared = away**2 + turned**2
        weight = np.exp(-0.5 * (squared - squared.min()))
        weight /= weight.sum()
        return np.concatenate([weight @ self._turn_back, weight @ self._move_back])


def _subtract_mean(values: np.ndarray) -> np.ndarray:
    """(F, K) less their mean over the frames around each: what drifts slowly is gone."""
    total = np.cumsum(np.pad(values, ((1, 0), (0, 0))), axis=0)
    frame = np.arange(len(values))
    first, last = np.maximum(frame - AROUND, 0), np.minimum(frame + AROUND + 1, len(values))
    return values - (total[last] - total[first]) / (last - first)[:, None]
