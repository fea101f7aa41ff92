"""Bundle adjustment with priors: poses, points and the camera are moved until they agree with what the images show.

Triggs, McLauchlan, Hartley, Fitzgibbon: "Bundle Adjustment - A Modern Synthesis", 1999. Each pose keeps a prior around
the pose that was given, because given poses of real datasets are right on the whole and wrong in detail.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.mapping.camera_correction import CameraCorrection
from lightning_pose.mapping.frames import MapFrames, find_turn_rates
from lightning_pose.mapping.normal_equations import NormalEquations, Unknowns
from lightning_pose.mapping.observations import Cameras, Observations

__all__ = ["Adjustment", "adjust_bundle"]

CAUCHY_PX = 2.0
"""Scale of Cauchy's weights on image errors, which is also the errors' standard deviation."""

POSE_SD = (0.005, 0.005)
"""Standard deviations of the given poses: radians, and a share of the median depth."""

OFFSET_SD = (0.005, 0.005)
"""Of the constant transform from the given pose to the camera: radians, and a share of the median depth."""

CAMERA_SD_PX = (5.0, 2.0)
"""Of the focal length, and of each coordinate of the principal point."""

DISTORTION_SD = 0.02
"""Of the first radial coefficient."""

READOUT_SD = 0.5
"""Of the time that the rows in one unit of normalised image coordinates take, in intervals between frames."""

STEPS = 6


@dataclass(frozen=True)
class Adjustment:
    """What bundle adjustment moves.

    Attributes:
        rotation: (F, 3, 3), camera-to-world rotations, near the given ones.
        position: (F, 3), near the given ones.
        points: (T, 3).
        offset_rotation: (3, 3), from the camera's axes to those of the given poses; the same for all frames.
        offset_position: (3,), where the camera stands in the axes of the given poses.
        camera: what is wrong with the assumed camera.
        rolling: whether the rows of an image are taken one after the other, while the camera turns.
        readout: time that they take for one unit of normalised y, in intervals between frames; 0 if not `rolling`.
    """

    rotation: np.ndarray
    position: np.ndarray
    points: np.ndarray
    offset_rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    offset_position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    camera: CameraCorrection = field(default_factory=CameraCorrection)
    rolling: bool = False
    readout: float = 0.0

    @property
    def camera_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (F, 3, 3) and centres (F, 3) of the cameras themselves, offset included."""
        return self.rotation @ self.offset_rotation, self.position + self.rotation @ self.offset_position

    @property
    def cameras(self) -> Cameras:
        """Where the cameras are, and what is wrong with the assumed one."""
        return Cameras(*self.camera_poses, self.camera, self.readout)


def adjust_bundle(
    start: Adjustment,
    given: MapFrames,
    track: np.ndarray,
    frame: np.ndarray,
    keypoint: np.ndarray,
    steps: int = STEPS,
) -> Adjustment:
    """Levenberg-Marquardt over poses, points and what all frames share; the points are eliminated (Schur complement).

    Args:
        start: where to begin.
        given: the frames with the poses that were given; priors hold the poses near them.
        track: (O,) int64, the point of each observation, ascending.
        frame: (O,) int64, its frame.
        keypoint: (O,) int64, its keypoint.
        steps: of Levenberg-Marquardt.
    """
    if not len(track):
        return start
    problem = _Problem(start, given, track, frame, keypoint)
    state, damping = start, 1e-4
    cost = problem.cost(state)
    for _ in range(steps):
        candidate = problem.step(state, damping)
        new_cost = problem.cost(candidate)
        if new_cost < cost:
            done = cost - new_cost < 1e-5 * cost
            state, cost, damping = candidate, new_cost, damping / 4
            if done:
                break
        else:
            damping *= 16
    return state


class _Problem:
    """What one bundle adjustment is about: observations and priors, its cost, and one step."""

    def __init__(
        self, start: Adjustment, given: MapFrames, track: np.ndarray, frame: np.ndarray, keypoint: np.ndarray
    ) -> None:
        self.given = given
        self.seen = Observations(
            track,
            frame,
            np.ascontiguousarray(given.points[frame, keypoint].T),
            CAUCHY_PX / given.focal_px[frame],
            find_turn_rates(given.rotation).T * start.rolling,
        )
        rotation, position = start.camera_poses
        axis, away = rotation[frame, :, 2], start.points[track] - position[frame]
        depth = float(np.median((axis * away).sum(axis=1)))
        self.pose_sd = np.repeat([POSE_SD[0], POSE_SD[1] * depth], 3)
        focal_px = float(np.median(given.focal_px))
        self.shared_sd = np.array(
            [OFFSET_SD[0]] * 3
            + [OFFSET_SD[1] * depth] * 3
            + [CAMERA_SD_PX[0] / focal_px]
            + [CAMERA_SD_PX[1] / focal_px] * 2
            + [DISTORTION_SD, READOUT_SD]
        )

    def prior_errors(self, state: Adjustment) -> tuple[np.ndarray, np.ndarray]:
        """(F, 6) and (11,): what has moved from where it was given, not yet divided by standard deviations."""
        turned = Rotation.from_matrix(np.swapaxes(self.given.rotation, 1, 2) @ state.rotation).as_rotvec()
        shared = np.concatenate(
            [
                Rotation.from_matrix(state.offset_rotation).as_rotvec(),
                state.offset_position,
                [state.camera.scale - 1],
                state.camera.centre,
                [state.camera.k1, state.readout],
            ]
        )
        return np.column_stack([turned, state.position - self.given.position]), shared

    def cost(self, state: Adjustment) -> float:
        """Cauchy's cost of the image errors and the squares of the priors."""
        of_poses, shared = self.prior_errors(state)
        priors = ((of_poses / self.pose_sd) ** 2).sum() + ((shared / self.shared_sd) ** 2).sum()
        return self.seen.cost(state.cameras, state.points) + float(priors)

    def step(self, state: Adjustment, damping: float) -> Adjustment:
        """Where one damped Gauss-Newton step leads."""
        equations = NormalEquations(self.seen, state.cameras, state.points, damping)
        pose_error, shared_error = self.prior_errors(state)
        unknowns = Unknowns(
            *_derive_cameras(state), pose_error, 1 / self.pose_sd**2, shared_error, 1 / self.shared_sd**2
        )
        move, shared, points = equations.solve(unknowns)
        return replace(
            state,
            rotation=state.rotation @ Rotation.from_rotvec(move[:, :3]).as_matrix(),
            position=state.position + move[:, 3:],
            points=state.points + points,
            offset_rotation=state.offset_rotation @ Rotation.from_rotvec(shared[:3]).as_matrix(),
            offset_position=state.offset_position + shared[3:6],
            camera=replace(
                state.camera,
                scale=state.camera.scale + float(shared[6]),
                centre=state.camera.centre + shared[7:9],
                k1=state.camera.k1 + float(shared[9]),
            ),
            readout=state.readout + float(shared[10]),
        )


def _derive_cameras(state: Adjustment) -> tuple[np.ndarray, np.ndarray]:
    """(F, 6, 6) each: how cameras move, turn in their own axes and place in the world, by their poses and the offset.

    A pose that turns by w in its own axes turns its camera by X^T w, and moves it by R (w x x), X and x the offset.
    """
    by_pose, by_offset = np.zeros((len(state.position), 6, 6)), np.zeros((len(state.position), 6, 6))
    by_pose[:, :3, :3] = state.offset_rotation.T
    by_pose[:, 3:, :3] = -state.rotation @ _cross_matrix(state.offset_position)
    by_pose[:, 3:, 3:] = by_offset[:, :3, :3] = np.eye(3)
    by_offset[:, 3:, 3:] = state.rotation
    return by_pose, by_offset


def _cross_matrix(vector: np.ndarray) -> np.ndarray:
    """The (3, 3) matrix C of a vector v (3,), so that C w = v x w."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
