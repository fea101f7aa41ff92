"""The normal equations of bundle adjustment, and one step of its solution.

Triggs, McLauchlan, Hartley, Fitzgibbon: "Bundle Adjustment - A Modern Synthesis", 1999, section 6: the points are
eliminated (Schur complement), and conjugate gradients find the rest without forming it. How a camera's movement `y`
follows from what adjustment moves is for the caller to say (`Unknowns`).
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from lightning_pose.mapping.observations import N_CAMERA, Cameras, Observations, View
from lightning_pose.mapping.threads import map_in_threads

__all__ = ["NormalEquations", "Unknowns"]

CG_STEPS = 15
"""Conjugate gradients are not run to their end: 300 of them, and 12 steps, locate frames no better."""

CG_TOLERANCE = 1e-2

PAIRS = tuple(combinations_with_replacement(range(6), 2))


class Unknowns(NamedTuple):
    """How cameras follow from what is adjusted, and how firmly that is held.

    Attributes:
        by_pose: (F, 6, 6), the movement `y` of a frame's camera by the movement of its pose.
        by_offset: (F, 6, 6), the same by the offset that all frames share.
        pose_error: (F, 6), by how much the poses are off their priors.
        pose_weight: (6,), inverse squares of the priors' standard deviations.
        shared_error: (11,), the same of the offset (6) and the numbers of all cameras (5).
        shared_weight: (11,).
    """

    by_pose: np.ndarray
    by_offset: np.ndarray
    pose_error: np.ndarray
    pose_weight: np.ndarray
    shared_error: np.ndarray
    shared_weight: np.ndarray


class _Part(NamedTuple):
    """Sums of the products of some observations' derivatives; the points' are whitened.

    `frames` is (21 + 36, K), of the K frames `present`: products of `y` with itself, above its diagonal, and with the
    numbers and the error.
    `shared` is (6, 6): of the numbers and the error. `whiten` is (T, 3, 3), which turns a point's block of the normal
    equations into the identity. `blocks` (O, 6, 3) are products of `y` with points, `points` (T, 3, 6) those of points
    with the numbers and the error.
    """

    present: np.ndarray
    frames: np.ndarray
    shared: np.ndarray
    whiten: np.ndarray
    blocks: np.ndarray
    points: np.ndarray


def _add_up(view: View, n_points: int, damping: float) -> _Part:
    """The sums of one part. A point moves as `y` does, the other way."""
    by_u, by_v = view.derive()
    track = view.seen.track
    present, frame = np.unique(view.seen.frame, return_inverse=True)
    own = [by_u[i] * by_u[j] + by_v[i] * by_v[j] for i, j in PAIRS]
    others = [by_u[i] * by_u[6:] + by_v[i] * by_v[6:] for i in range(6)]
    number = {pair: at for at, pair in enumerate(PAIRS)}
    of_point = _sum_rows(
        track, (own[number[3 + min(i, j), 3 + max(i, j)]] for i in range(3) for j in range(3)), n_points
    )
    block = of_point.T.reshape(-1, 3, 3)
    trace = np.trace(block, axis1=1, axis2=2)[:, None, None]
    whiten = np.linalg.inv(np.linalg.cholesky(block + np.eye(3) * (damping * trace / 3 + 1e-12)))
    of_both = -_sum_rows(track, (row for rows in others[3:] for row in rows), n_points).T.reshape(-1, 3, 6)
    lower = whiten.reshape(-1, 9).T.take(track, axis=1)
    blocks = np.empty((len(track), 6, 3))
    for i in range(6):
        x, y, z = (own[number[min(i, 3 + j), max(i, 3 + j)]] for j in range(3))
        blocks[:, i, 0] = -lower[0] * x
        blocks[:, i, 1] = -lower[3] * x - lower[4] * y
        blocks[:, i, 2] = -lower[6] * x - lower[7] * y - lower[8] * z
    frames = _sum_rows(frame, [*own, *(row for rows in others for row in rows)], len(present))
    return _Part(present, frames, by_u[6:] @ by_u[6:].T + by_v[6:] @ by_v[6:].T, whiten, blocks, whiten @ of_both)


class NormalEquations:
    """The normal equations at some cameras and points.

    Args:
        seen: the observations.
        cameras: where the cameras are.
        points: (T, 3).
        damping: of Levenberg-Marquardt.
    """

    def __init__(self, seen: Observations, cameras: Cameras, points: np.ndarray, damping: float) -> None:
        n = len(cameras.position)

        def add_up(ends: tuple[int, int]) -> _Part:
            return _add_up(View(seen.part(*ends), cameras, points[slice(*ends)]), ends[1] - ends[0], damping)

        parts = map_in_threads(add_up, seen.ends())
        frames = np.zeros((len(PAIRS) + 36, n))
        for part in parts:
            frames[:, part.present] += part.frames
        shared = np.sum([part.shared for part in parts], axis=0)
        own, other = np.triu_indices(6)
        self.of_y = np.empty((n, 6, 6))
        self.of_y[:, own, other] = self.of_y[:, other, own] = frames[:21].T
        with_others = frames[21:].T.reshape(n, 6, 6)
        self.of_both, self.y_right = with_others[:, :, :N_CAMERA], with_others[:, :, N_CAMERA]
        self.of_numbers, self.number_right = shared[:N_CAMERA, :N_CAMERA], shared[:N_CAMERA, N_CAMERA]
        self.whiten = np.concatenate([part.whiten for part in parts])
        of_points = np.concatenate([part.points for part in parts])
        self.point_numbers = of_points[:, :, :N_CAMERA].reshape(-1, N_CAMERA)
        self.point_right = of_points[:, :, N_CAMERA].ravel()
        blocks = np.concatenate([part.blocks for part in parts])
        by_frame = np.argsort(seen.frame, kind="stable")
        self.to_frames = _place_blocks(blocks[by_frame], seen.frame[by_frame], seen.track[by_frame], n, len(points))
        self.to_points = _place_blocks(blocks.swapaxes(1, 2), seen.track, seen.frame, len(points), n)
        self.damping = damping

    def solve(self, unknowns: Unknowns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The steps of poses (F, 6), of what is shared (11,), and of points (T, 3)."""
        n = len(self.of_y)
        poses_right, shared_right = self._pull_back(
            unknowns,
            self.y_right - self._to_frames(self.point_right),
            self.number_right - self._to_numbers(self.point_right),
        )
        poses_right += unknowns.pose_error * unknowns.pose_weight
        shared_right += unknowns.shared_error * unknowns.shared_weight
        pose_weight, shared_weight = (
            (1 + self.damping) * each for each in (unknowns.pose_weight, unknowns.shared_weight)
        )

        def multiply(x: np.ndarray) -> np.ndarray:
            poses, shared = x[: 6 * n].reshape(n, 6), x[6 * n :]
            y, numbers = self._push(unknowns, poses, shared)
            points = self._find_points(y, numbers)
            of_y = _multiply(self.of_y, y) + self.of_both @ numbers - self._to_frames(points)
            of_numbers = np.tensordot(y, self.of_both, 2) + self.of_numbers @ numbers - self._to_numbers(points)
            of_poses, of_shared = self._pull_back(unknowns, of_y, of_numbers)
            return np.concatenate([(of_poses + pose_weight * poses).ravel(), of_shared + shared_weight * shared])

        inverse_poses, inverse_shared = self._invert_diagonal(unknowns, pose_weight, shared_weight)

        def precondition(x: np.ndarray) -> np.ndarray:
            return np.concatenate(
                [_multiply(inverse_poses, x[: 6 * n].reshape(n, 6)).ravel(), inverse_shared @ x[6 * n :]]
            )

        right = -np.concatenate([poses_right.ravel(), shared_right])
        shape = (len(right), len(right))
        x, _ = cg(
            LinearOperator(shape, matvec=multiply),  # pyright: ignore[reportCallIssue]
            right,
            rtol=CG_TOLERANCE,
            maxiter=CG_STEPS,
            M=LinearOperator(shape, matvec=precondition),  # pyright: ignore[reportCallIssue]
        )
        poses, shared = x[: 6 * n].reshape(n, 6), x[6 * n :]
        white = -(self.point_right + self._find_points(*self._push(unknowns, poses, shared))).reshape(-1, 3)
        return poses, shared, _multiply(self.whiten.swapaxes(1, 2), white)

    def _push(self, unknowns: Unknowns, poses: np.ndarray, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How cameras move (F, 6), and their numbers (5,)."""
        return _multiply(unknowns.by_pose, poses) + unknowns.by_offset @ shared[:6], shared[6:]

    def _pull_back(self, unknowns: Unknowns, of_y: np.ndarray, of_numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The transpose of `_push`."""
        of_offset = np.tensordot(of_y, unknowns.by_offset, 2)
        return _multiply(unknowns.by_pose.swapaxes(1, 2), of_y), np.concatenate([of_offset, of_numbers])

    def _find_points(self, y: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        return self.to_points @ y.ravel() + self.point_numbers @ numbers

    def _to_frames(self, points: np.ndarray) -> np.ndarray:
        return (self.to_frames @ points).reshape(-1, 6)

    def _to_numbers(self, points: np.ndarray) -> np.ndarray:
        return points @ self.point_numbers

    def _invert_diagonal(
        self, unknowns: Unknowns, pose_weight: np.ndarray, shared_weight: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Inverses of the blocks of each pose (F, 6, 6) and of what is shared (11, 11), points not eliminated."""
        poses = unknowns.by_pose.swapaxes(1, 2) @ self.of_y @ unknowns.by_pose
        back = unknowns.by_offset.swapaxes(1, 2)
        offset, mixed = (back @ self.of_y @ unknowns.by_offset).sum(axis=0), (back @ self.of_both).sum(axis=0)
        shared = np.block([[offset, mixed], [mixed.T, self.of_numbers]])
        return np.linalg.inv(poses + np.diag(pose_weight)), np.linalg.inv(shared + np.diag(shared_weight))


def _sum_rows(group: np.ndarray, rows: Iterable[np.ndarray], n_groups: int) -> np.ndarray:
    """(K, G) sums of each of K rows (O,) in each group."""
    return np.stack([np.bincount(group, row, n_groups) for row in rows])


def _multiply(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """(N, I) products of (N, I, J) matrices and (N, J) vectors."""
    return np.einsum("nij,nj->ni", matrices, vectors)


def _place_blocks(
    blocks: np.ndarray, row: np.ndarray, column: np.ndarray, n_rows: int, n_columns: int
) -> sparse.bsr_matrix:
    """(I n_rows, J n_columns) with the (O, I, J) blocks at block rows `row`, ascending, and block columns `column`."""
    _, height, width = blocks.shape
    start = np.searchsorted(row, np.arange(n_rows + 1))
    shape = (height * n_rows, width * n_columns)
    return sparse.bsr_matrix((np.ascontiguousarray(blocks), column, start), shape=shape)
