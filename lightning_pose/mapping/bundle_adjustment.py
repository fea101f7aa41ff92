"""Bundle adjustment with priors: poses, points and the camera are moved until they agree with what the images show.

Triggs, McLauchlan, Hartley, Fitzgibbon: "Bundle Adjustment - A Modern Synthesis", 1999. Each pose keeps a prior around
the pose that was given, because given poses of real datasets are right on the whole and wrong in detail.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.rolling_shutter import derive_rolling
from lightning_pose.geometry.triangulation import sum_by_track
from lightning_pose.mapping.frames import MapFrames, find_turn_rates

__all__ = ["POSE_SD", "Adjustment", "CameraCorrection", "adjust_bundle", "measure_pose_sd"]

CAUCHY_PX = 2.0
"""Scale of Cauchy's weights on image errors, which is also the errors' standard deviation."""

POSE_SD = (0.005, 0.005)
"""Standard deviations of the given poses before they are measured: radians, and a share of the median depth."""

OFFSET_SD = (0.005, 0.005)
"""Of the constant transform from the given pose to the camera: radians, and a share of the median depth."""

CAMERA_SD_PX = (5.0, 2.0)
"""Of the focal length, and of each coordinate of the principal point."""

DISTORTION_SD = 0.02
"""Of the first radial coefficient."""

READOUT_SD = 0.5
"""Of the time that the rows in one unit of normalised image coordinates take, in intervals between frames."""

STEPS = 6
CG_STEPS = 15
"""Conjugate gradients are not run to their end: 300 of them, and 12 steps, locate frames no better."""

CG_TOLERANCE = 1e-2


@dataclass(frozen=True)
class CameraCorrection:
    """Small errors of the assumed camera, as far as the map needs them. They are no calibration.

    Attributes:
        scale: true focal length by the assumed one.
        centre: (2,) true principal point less the assumed one, in normalised image coordinates.
        k1: first radial distortion coefficient.
    """

    scale: float = 1.0
    centre: np.ndarray = field(default_factory=lambda: np.zeros(2))
    k1: float = 0.0

    def distort(self, points: np.ndarray) -> np.ndarray:
        """Where (..., 2) ideal points appear under the assumed camera."""
        squared = (points**2).sum(axis=-1, keepdims=True)
        return self.scale * points * (1 + self.k1 * squared) + self.centre

    def remove(self, points: np.ndarray) -> np.ndarray:
        """The ideal points of (..., 2) points under the assumed camera: the inverse of `distort`."""
        distorted = (points - self.centre) / self.scale
        ideal = distorted
        for _ in range(5):
            ideal = distorted / (1 + self.k1 * (ideal**2).sum(axis=-1, keepdims=True))
        return ideal


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
        pose_sd: standard deviations of the given poses, as `POSE_SD`.
    """

    rotation: np.ndarray
    position: np.ndarray
    points: np.ndarray
    offset_rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    offset_position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    camera: CameraCorrection = CameraCorrection()
    rolling: bool = False
    readout: float = 0.0
    pose_sd: tuple[float, float] = POSE_SD

    @property
    def camera_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (F, 3, 3) and centres (F, 3) of the cameras themselves, offset included."""
        return self.rotation @ self.offset_rotation, self.position + self.rotation @ self.offset_position


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


def measure_pose_sd(
    state: Adjustment, given: MapFrames, track: np.ndarray, frame: np.ndarray, keypoint: np.ndarray
) -> tuple[float, float]:
    """By how much an adjustment with the arguments of `adjust_bundle` has moved the poses, as `POSE_SD`, at most that.

    Poses that the images hardly move are right in detail, and are held tighter from then on.
    """
    problem = _Problem(state, given, track, frame, keypoint)
    moved, _ = problem.prior_errors(state)
    turn_sd, move_sd = (float(np.sqrt((part**2).mean())) for part in (moved[:, :3], moved[:, 3:] / problem.depth))
    return min(turn_sd, POSE_SD[0]), min(move_sd, POSE_SD[1])


class _Problem:
    """The residuals of one bundle adjustment, their derivatives, and one step."""

    def __init__(
        self, start: Adjustment, given: MapFrames, track: np.ndarray, frame: np.ndarray, keypoint: np.ndarray
    ) -> None:
        self.given, self.track, self.frame = given, track, frame
        self.observed = given.points[frame, keypoint]
        self.turn_rate = find_turn_rates(given.rotation)[frame][:, :, None] * start.rolling
        self.sigma = CAUCHY_PX / given.focal_px[frame]
        rotation, position = start.camera_poses
        local = np.einsum("oji,oj->oi", rotation[frame], start.points[track] - position[frame])
        depth = self.depth = float(np.median(local[:, 2]))
        self.pose_sd = np.repeat([start.pose_sd[0], start.pose_sd[1] * depth], 3)
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

    def image_errors(self, state: Adjustment) -> tuple[np.ndarray, np.ndarray]:
        """(O, 2) projected less observed, and the points in their cameras (O, 3)."""
        rotation, position = state.camera_poses
        local = np.einsum("oji,oj->oi", rotation[self.frame], state.points[self.track] - position[self.frame])
        ideal = local[:, :2] / np.maximum(local[:, 2:], 1e-9)
        rolled = ideal + state.readout * self.find_rolling(ideal)
        return state.camera.distort(rolled) - self.observed, local

    def find_rolling(self, ideal: np.ndarray) -> np.ndarray:
        """(O, 2) by how much a rolling shutter whose readout is 1 moves (O, 2) points."""
        return (derive_rolling(ideal) @ self.turn_rate)[:, :, 0]

    def cost(self, state: Adjustment) -> float:
        """Cauchy's cost of the image errors and the squares of the priors."""
        error, local = self.image_errors(state)
        squared = np.where(local[:, 2] > 0, (error**2).sum(axis=1) / self.sigma**2, 1e6)
        of_poses, shared = self.prior_errors(state)
        priors = ((of_poses / self.pose_sd) ** 2).sum() + ((shared / self.shared_sd) ** 2).sum()
        return float(np.log1p(squared).sum() + priors)

    def step(self, state: Adjustment, damping: float) -> Adjustment:
        """Where one damped Gauss-Newton step leads."""
        error, local = self.image_errors(state)
        root = np.sqrt(1 / (1 + (error**2).sum(axis=1) / self.sigma**2)) / self.sigma
        root = np.where(local[:, 2] > 0, root, 0.0)
        of_pose, of_shared, of_point = self._derive(state, local)
        of_pose, of_shared, of_point = (block * root[:, None, None] for block in (of_pose, of_shared, of_point))
        move, shared, points = _solve_schur(
            (of_pose, of_shared, of_point),
            (error * root[:, None]),
            (self.frame, self.track, len(self.given), len(state.points)),
            (self.prior_errors(state), self.pose_sd, self.shared_sd),
            damping,
        )
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

    def _derive(self, state: Adjustment, local: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of the image errors: by pose (O, 2, 6), by what is shared (O, 2, 11), by point (O, 2, 3)."""
        z = np.maximum(local[:, 2], 1e-9)
        ideal = local[:, :2] / z[:, None]
        squared = (ideal**2).sum(axis=1)
        camera = state.camera
        bent = camera.scale * (
            (1 + camera.k1 * squared)[:, None, None] * np.eye(2) + 2 * camera.k1 * ideal[:, :, None] * ideal[:, None, :]
        )
        project = np.zeros((len(z), 2, 3))
        project[:, 0, 0] = project[:, 1, 1] = 1 / z
        project[:, :, 2] = -ideal / z[:, None]
        by_local = bent @ project
        rotation, _ = state.camera_poses
        to_camera = np.swapaxes(rotation, 1, 2)[self.frame]
        by_point = by_local @ to_camera
        # The given pose turns by w in its own axes: local = X^T (exp(-w) (R^T (p - c)) - x), X and x the offset.
        in_given = np.einsum("ij,oj->oi", state.offset_rotation, local) + state.offset_position
        by_given = by_local @ state.offset_rotation.T
        of_pose = np.concatenate([by_given @ _cross_matrices(in_given), -by_point], axis=2)
        of_shared = np.concatenate(
            [
                by_local @ _cross_matrices(local),
                -by_given,
                (ideal * (1 + camera.k1 * squared)[:, None])[:, :, None],
                np.broadcast_to(np.eye(2), (len(z), 2, 2)),
                (camera.scale * ideal * squared[:, None])[:, :, None],
                self.find_rolling(ideal)[:, :, None],
            ],
            axis=2,
        )
        return of_pose, of_shared, by_point


def _solve_schur(
    blocks: tuple[np.ndarray, np.ndarray, np.ndarray],
    error: np.ndarray,
    sizes: tuple[np.ndarray, np.ndarray, int, int],
    priors: tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray],
    damping: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve the normal equations: conjugate gradients on poses and shared numbers, the points eliminated.

    Returns:
        the steps of poses (F, 6), of what is shared (11,), and of points (T, 3).
    """
    of_pose, of_shared, of_point = blocks
    frame, track, n_frames, n_points = sizes
    (pose_error, shared_error), pose_sd, shared_sd = priors
    by_frame = np.argsort(frame, kind="stable")

    def sum_by_frame(values: np.ndarray) -> np.ndarray:
        return sum_by_track(frame, values.reshape(len(frame), -1), n_frames).reshape(-1, *values.shape[1:])

    def sum_by_point(values: np.ndarray) -> np.ndarray:
        return sum_by_track(track, values.reshape(len(track), -1), n_points).reshape(-1, *values.shape[1:])

    # Points are whitened: their block of the normal equations becomes the identity.
    point_block = sum_by_point(_multiply_blocks(of_point, of_point))
    trace = np.trace(point_block, axis1=1, axis2=2)[:, None, None]
    whiten = np.linalg.inv(np.linalg.cholesky(point_block + np.eye(3) * (damping * trace / 3 + 1e-12)))
    of_point = of_point @ np.swapaxes(whiten, 1, 2)[track]
    pose_block = sum_by_frame(_multiply_blocks(of_pose, of_pose)) + np.diag((1 + damping) / pose_sd**2)
    both_block = sum_by_frame(_multiply_blocks(of_pose, of_shared)).reshape(6 * n_frames, -1)
    flat_shared = of_shared.reshape(-1, of_shared.shape[2])
    shared_block = np.einsum("oi,oj->ij", flat_shared, flat_shared) + np.diag((1 + damping) / shared_sd**2)
    pose_point = _multiply_blocks(of_pose, of_point)
    to_frames = _place_blocks(pose_point[by_frame], frame[by_frame], track[by_frame], n_frames, n_points)
    to_points = _place_blocks(np.swapaxes(pose_point, 1, 2), track, frame, n_points, n_frames)
    shared_point = sum_by_point(_multiply_blocks(of_point, of_shared)).reshape(3 * n_points, -1)
    point_right = sum_by_point(_multiply_blocks(of_point, error[:, :, None])).ravel()
    split = 6 * n_frames

    def find_points(x: np.ndarray) -> np.ndarray:
        return to_points @ x[:split] + np.einsum("ts,s->t", shared_point, x[split:])

    def multiply(x: np.ndarray) -> np.ndarray:
        points, poses, shared = find_points(x), x[:split], x[split:]
        of_poses = np.einsum("fij,fj->fi", pose_block, poses.reshape(-1, 6)).ravel()
        of_poses += np.einsum("fs,s->f", both_block, shared) - to_frames @ points
        of_both = np.einsum("fs,f->s", both_block, poses) - np.einsum("ts,t->s", shared_point, points)
        return np.concatenate([of_poses, of_both + shared_block @ shared])

    precondition_poses, precondition_shared = np.linalg.inv(pose_block), np.linalg.inv(shared_block)

    def precondition(x: np.ndarray) -> np.ndarray:
        poses = np.einsum("fij,fj->fi", precondition_poses, x[:split].reshape(-1, 6)).ravel()
        return np.concatenate([poses, precondition_shared @ x[split:]])

    of_poses = sum_by_frame(_multiply_blocks(of_pose, error[:, :, None])).ravel() - to_frames @ point_right
    of_both = np.einsum("oi,o->i", flat_shared, error.ravel()) - np.einsum("ts,t->s", shared_point, point_right)
    right = -np.concatenate([of_poses + (pose_error / pose_sd**2).ravel(), of_both + shared_error / shared_sd**2])
    shape = (len(right), len(right))
    x, _ = cg(
        LinearOperator(shape, matvec=multiply),  # pyright: ignore[reportCallIssue]
        right,
        rtol=CG_TOLERANCE,
        maxiter=CG_STEPS,
        M=LinearOperator(shape, matvec=precondition),  # pyright: ignore[reportCallIssue]
    )
    white = -(point_right + find_points(x)).reshape(-1, 3)
    return x[:split].reshape(-1, 6), x[split:], np.einsum("tji,tj->ti", whiten, white)


def _multiply_blocks(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(O, I, J), the products of the transposed (O, 2, I) with (O, 2, J)."""
    return np.swapaxes(a, 1, 2) @ b


def _place_blocks(
    blocks: np.ndarray, row: np.ndarray, column: np.ndarray, n_rows: int, n_columns: int
) -> sparse.bsr_matrix:
    """(I n_rows, J n_columns) with the (O, I, J) blocks at block rows `row`, ascending, and block columns `column`."""
    _, height, width = blocks.shape
    start = np.searchsorted(row, np.arange(n_rows + 1))
    shape = (height * n_rows, width * n_columns)
    return sparse.bsr_matrix((np.ascontiguousarray(blocks), column, start), shape=shape)


def _cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """(N, 3, 3) matrices C of (N, 3) vectors v, so that C w = v x w."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
