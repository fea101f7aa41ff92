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

from lightning_pose.mapping.frames import MapFrames

__all__ = ["Adjustment", "CameraCorrection", "adjust_bundle"]

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

STEPS = 10
CG_STEPS = 60
CG_TOLERANCE = 1e-3


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
    """

    rotation: np.ndarray
    position: np.ndarray
    points: np.ndarray
    offset_rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    offset_position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    camera: CameraCorrection = CameraCorrection()

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


class _Problem:
    """The residuals of one bundle adjustment, their derivatives, and one step."""

    def __init__(
        self, start: Adjustment, given: MapFrames, track: np.ndarray, frame: np.ndarray, keypoint: np.ndarray
    ) -> None:
        self.given, self.track, self.frame = given, track, frame
        self.observed = given.points[frame, keypoint]
        self.sigma = CAUCHY_PX / given.focal_px[frame]
        rotation, position = start.camera_poses
        local = np.einsum("oji,oj->oi", rotation[frame], start.points[track] - position[frame])
        depth = float(np.median(local[:, 2]))
        self.pose_sd = np.repeat([POSE_SD[0], POSE_SD[1] * depth], 3)
        focal_px = float(np.median(given.focal_px))
        self.shared_sd = np.array(
            [OFFSET_SD[0]] * 3
            + [OFFSET_SD[1] * depth] * 3
            + [CAMERA_SD_PX[0] / focal_px]
            + [CAMERA_SD_PX[1] / focal_px] * 2
            + [DISTORTION_SD]
        )

    def prior_errors(self, state: Adjustment) -> tuple[np.ndarray, np.ndarray]:
        """(F, 6) and (10,): what has moved from where it was given, not yet divided by standard deviations."""
        turned = Rotation.from_matrix(np.swapaxes(self.given.rotation, 1, 2) @ state.rotation).as_rotvec()
        shared = np.concatenate(
            [
                Rotation.from_matrix(state.offset_rotation).as_rotvec(),
                state.offset_position,
                [state.camera.scale - 1],
                state.camera.centre,
                [state.camera.k1],
            ]
        )
        return np.column_stack([turned, state.position - self.given.position]), shared

    def image_errors(self, state: Adjustment) -> tuple[np.ndarray, np.ndarray]:
        """(O, 2) projected less observed, and the points in their cameras (O, 3)."""
        rotation, position = state.camera_poses
        local = np.einsum("oji,oj->oi", rotation[self.frame], state.points[self.track] - position[self.frame])
        ideal = local[:, :2] / np.maximum(local[:, 2:], 1e-9)
        return state.camera.distort(ideal) - self.observed, local

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
        return Adjustment(
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
        )

    def _derive(self, state: Adjustment, local: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of the image errors: by pose (O, 2, 6), by what is shared (O, 2, 10), by point (O, 2, 3)."""
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
        the steps of poses (F, 6), of what is shared (10,), and of points (T, 3).
    """
    of_pose, of_shared, of_point = blocks
    frame, track, n_frames, n_points = sizes
    (pose_error, shared_error), pose_sd, shared_sd = priors
    rows = len(error)
    by_pose = _place_blocks(of_pose, frame, n_frames)
    by_point = _place_blocks(of_point, track, n_points)
    by_shared = of_shared.reshape(2 * rows, -1)
    flat = error.ravel()

    point_blocks = np.zeros((n_points, 3, 3))
    np.add.at(point_blocks, track, np.einsum("oki,okj->oij", of_point, of_point))
    trace = np.trace(point_blocks, axis1=1, axis2=2)[:, None, None]
    inverse = np.linalg.inv(point_blocks + np.eye(3) * (damping * trace / 3 + 1e-12))
    pose_blocks = np.zeros((n_frames, 6, 6))
    np.add.at(pose_blocks, frame, np.einsum("oki,okj->oij", of_pose, of_pose))
    pose_blocks += np.diag(1 / pose_sd**2) * (1 + damping)
    precondition_poses = np.linalg.inv(pose_blocks)
    shared_block = by_shared.T @ by_shared + np.diag(1 / shared_sd**2) * (1 + damping)
    precondition_shared = np.linalg.inv(shared_block)
    split = 6 * n_frames
    prior = np.concatenate([np.tile(1 / pose_sd**2, n_frames), 1 / shared_sd**2])

    def eliminate(values: np.ndarray) -> np.ndarray:
        return np.einsum("tij,tj->ti", inverse, (by_point.T @ values).reshape(-1, 3)).ravel()

    def multiply(x: np.ndarray) -> np.ndarray:
        image = by_pose @ x[:split] + by_shared @ x[split:]
        image = image - by_point @ eliminate(image)
        return np.concatenate([by_pose.T @ image, by_shared.T @ image]) + prior * (1 + damping) * x

    def precondition(x: np.ndarray) -> np.ndarray:
        poses = np.einsum("fij,fj->fi", precondition_poses, x[:split].reshape(-1, 6)).ravel()
        return np.concatenate([poses, precondition_shared @ x[split:]])

    reduced = flat - by_point @ eliminate(flat)
    right = -np.concatenate([by_pose.T @ reduced, by_shared.T @ reduced])
    right -= prior * np.concatenate([pose_error.ravel(), shared_error])
    shape = (len(right), len(right))
    x, _ = cg(
        LinearOperator(shape, matvec=multiply),  # pyright: ignore[reportCallIssue]
        right,
        rtol=CG_TOLERANCE,
        maxiter=CG_STEPS,
        M=LinearOperator(shape, matvec=precondition),  # pyright: ignore[reportCallIssue]
    )
    points = -eliminate(flat + by_pose @ x[:split] + by_shared @ x[split:])
    return x[:split].reshape(-1, 6), x[split:], points.reshape(-1, 3)


def _place_blocks(blocks: np.ndarray, column: np.ndarray, n_columns: int) -> sparse.csr_matrix:
    """(2 O, K n) with block (2, K) number o in rows 2 o and 2 o + 1, at block column `column[o]`."""
    rows, _, width = blocks.shape
    columns = (column[:, None, None] * width + np.arange(width)).repeat(2, axis=1)
    return sparse.csr_matrix(
        (blocks.ravel(), columns.ravel(), np.arange(2 * rows + 1) * width), shape=(2 * rows, n_columns * width)
    )


def _cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """(N, 3, 3) matrices C of (N, 3) vectors v, so that C w = v x w."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
