"""Locating one image in a point map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.absolute_pose import MAX_ITERATIONS, CameraPose, find_pose_ransac, refine_pose
from lightning_pose.geometry.rolling_shutter import TurningPose, refine_turning_pose, remove_rolling
from lightning_pose.mapping.frames import MapQuery
from lightning_pose.mapping.given_poses import GivenPoses
from lightning_pose.mapping.point_map import PointMap
from lightning_pose.mapping.query_matching import NONE, QueryMatcher

__all__ = ["MapAnswer", "MapLocalizer", "ShownPoints"]

MIN_MATCHES = 8
"""Fewer matches are no start for RANSAC."""

CANDIDATES, FEW_CANDIDATES, ALONE = 12, 4, 8
"""Training frames whose points an image is matched to together; fewer if it is refused; and then so many one by one."""

RANSAC_PX = 10.0
"""Errors of the map where it is weakest are above an image's."""

ITERATIONS_AGAIN = 200
"""Of RANSAC, where an image was refused before: images of other places would take most of the time."""

SIGMA_PX = 1.0
"""Scale of Cauchy's weights in the last refinement."""

PLACE_VARIANCE = 10.0
"""Variance of the errors that place a point, by that of an image's: errors of the map's poses do not average out."""

INLIER_PX = 3.0
ACCEPT_INLIERS = 16
"""Guided matches within 3 px that an accepted pose needs. Of training frames left out with 14 or 15, a fourth
are wrong."""

ACCEPT_SHARE = 0.015
"""Share of the points in view that must be inliers: chance matches grow with them. `SURE_INLIERS` are enough."""

ACCEPT_SD = (0.03, 1.5)
"""Standard deviations that an accepted pose of fewer may have: in median depths, and degrees."""

PRIOR = (0.5, 30.0)
"""How far a pose may lie from a prior: in median depths of the map's points, and degrees."""

PRIOR_PX = 64.0
"""How far a keypoint may lie from where a prior puts its point."""

SURE_INLIERS = 40
MOST_PASSES = 6
"""Guided passes; after each, fewer inliers than that are matched anew from the better pose, `MIN_MATCHES` at least."""


class ShownPoints(NamedTuple):
    """What a map shows in an image: normalised image coordinates, the camera's error removed.

    Attributes:
        seen: (V, 2), where points appear that the image should show.
        projected: (K, 2), where those appear that were matched.
        observed: (K, 2), their keypoints.
        inlier: (K,) bool, whether the two lie within 3 px.
    """

    seen: np.ndarray
    projected: np.ndarray
    observed: np.ndarray
    inlier: np.ndarray


@dataclass(frozen=True)
class MapAnswer:
    """Where an image was taken, and how sure the map is.

    Attributes:
        pose: in the poses that the dataset gives; of the most similar training frame where nothing better was found.
        pose_in_map: the same before it was carried back to the given poses.
        inliers: guided matches within 3 px.
        visible: points of the map that the image should show.
        reason: why the map refuses; empty where it accepts.
        position_sd: standard deviation of the position by the image errors alone, in the scene's unit; inf if refused
            before a pose was refined. Calibration turns it into a radius.
        orientation_sd_deg: the same of the orientation, in degrees.
        covariance: (6, 6), of a rotation in the camera's axes (radians) and a movement in the world's.
        shown: the points that the image shows; None if refused before a pose was refined.
    """

    pose: CameraPose
    pose_in_map: CameraPose
    inliers: int
    visible: int
    reason: str
    position_sd: float = np.inf
    orientation_sd_deg: float = np.inf
    covariance: np.ndarray | None = None
    shown: ShownPoints | None = None

    @property
    def accepted(self) -> bool:
        return not self.reason

    @property
    def source(self) -> Literal["map", "nearest"]:
        """What the pose comes from: its inliers in the map, even if they are too few, or the most similar frame."""
        return "nearest" if self.covariance is None else "map"


class MapLocalizer:
    """A map, prepared for queries.

    Args:
        point_map: the map; at least one training frame.
        without: numbers of training frames that answers may not use, as if they had not been in the training.

    Attributes:
        given_poses: carries poses from the map to those of the dataset, and back.
    """

    def __init__(self, point_map: PointMap, without: np.ndarray | None = None) -> None:
        self.map = point_map
        self._matcher = QueryMatcher(point_map)
        self._camera = point_map.camera_correction
        self.given_poses = GivenPoses(point_map, without)
        self._first = int(self.given_poses.kept[0])
        self._turn_sd, self._depth = self.given_poses.turn_sd, point_map.measure_depth()
        self._covariance = point_map.measure_covariances()

    def locate(self, query: MapQuery, prior: CameraPose | None = None) -> MapAnswer:
        """Where the image was taken: candidates, matches, RANSAC, one guided pass, refinement.

        Args:
            query: the image.
            prior: where it may have been taken, in the poses that the dataset gives. A pose near it is accepted as
                without. Where none is found, points that the image should show there are matched. A pose that is not
                near it is refused.
        """
        points = self._camera.remove(query.points)
        found = self._search(query, points)
        if prior is None:
            return found
        near = self.given_poses.carry_forward(prior)
        away, turned = self._measure_distance(found.pose_in_map, near)
        if found.accepted and away <= PRIOR[0] and turned <= PRIOR[1]:
            return found
        tracked = self._track(query, points, near)
        if tracked is None and found.accepted:
            reason = f"contradicts the prior: {away:.1f} times the scene's median depth and {turned:.0f} degrees away"
            return replace(found, reason=reason)
        return found if tracked is None else tracked

    def _track(self, query: MapQuery, points: np.ndarray, near: CameraPose) -> MapAnswer | None:
        """The accepted pose among the points that a pose of the map should show; None if there is none near it."""
        matches = self._matcher.match_guided(query, points, near, PRIOR_PX)
        found = self._solve(query, points, (-1, *matches[:2]))
        if not found.accepted:
            return None
        away, turned = self._measure_distance(found.pose_in_map, near)
        return found if away <= PRIOR[0] and turned <= PRIOR[1] else None

    def _measure_distance(self, a: CameraPose, b: CameraPose) -> tuple[float, float]:
        """Distance of two poses in median depths, and their angle in degrees."""
        away = float(np.linalg.norm(a.position - b.position)) / self._depth
        return away, float(np.degrees(np.linalg.norm(Rotation.from_matrix(a.rotation.T @ b.rotation).as_rotvec())))

    def _search(self, query: MapQuery, points: np.ndarray) -> MapAnswer:
        """The pose among the points of the most similar training frames; if it is refused, of fewer of them.

        Frames that look alike and show another place spoil the matches of the right ones, the more of them there are.
        """
        ranked = self._matcher.rank_frames(query.descriptors)[:CANDIDATES]
        if not len(ranked):
            return self._solve(query, points, (self._first, NONE, NONE))
        refused: list[MapAnswer] = []
        for some in (ranked, ranked[:FEW_CANDIDATES], *ranked[:ALONE, None]):
            matches = int(some[0]), *self._matcher.match_frames(query.descriptors, some)
            found = self._solve(query, points, matches, ITERATIONS_AGAIN if refused else MAX_ITERATIONS)
            if found.accepted:
                return found
            refused.append(found)
        return max(refused, key=lambda answer: answer.inliers)

    def _solve(
        self,
        query: MapQuery,
        points: np.ndarray,
        matches: tuple[int, np.ndarray, np.ndarray],
        iterations: int = MAX_ITERATIONS,
    ) -> MapAnswer:
        """The pose on which most matches agree, after one guided pass and refinement.

        Args:
            query: the image.
            points: (N, 2), its keypoints with the camera's error removed.
            matches: the frame whose pose holds where none is found, keypoints (K,) and points (K,).
            iterations: of RANSAC.
        """
        frame, rows, matched = matches
        if len(rows) < MIN_MATCHES:
            few = f"too few features: {len(points)}" if len(points) < MIN_MATCHES else f"too few matches: {len(rows)}"
            return self._refuse(frame, few)
        found = find_pose_ransac(self.map.points[matched], points[rows], RANSAC_PX / query.focal_px, iterations)
        if found is None:
            return self._refuse(frame, f"weak geometry: no pose agrees with four of {len(rows)} matches")
        pose, mask = found
        sigma = SIGMA_PX / query.focal_px
        refined = self._refine(pose, matched[mask], points[rows[mask]], 2 * sigma, steps=3)
        for _ in range(MOST_PASSES):
            still = remove_rolling(points, refined.turn)
            rows, matched, seen = self._matcher.match_guided(query, still, refined.pose)
            visible = len(seen)
            if len(rows) < MIN_MATCHES:
                return self._refuse(frame, f"too few guided matches: {len(rows)} of {visible} points in view", visible)
            refined = self._refine(refined.pose, matched, points[rows], sigma)
            observed = remove_rolling(points[rows], refined.turn)
            local = (self.map.points[matched] - refined.pose.position) @ refined.pose.rotation
            projected = local[:, :2] / np.maximum(local[:, 2:], 1e-9)
            inlier = np.linalg.norm(projected - observed, axis=1) * query.focal_px <= INLIER_PX
            inliers = int(inlier.sum())
            if inliers >= SURE_INLIERS or inliers < MIN_MATCHES:
                break
        return self._answer(refined, inliers, visible, ShownPoints(seen, projected, observed, inlier))

    def _refine(
        self, pose: CameraPose, matched: np.ndarray, observed: np.ndarray, sigma: float, steps: int = 8
    ) -> TurningPose:
        """The pose that fits points `matched` (N,) seen at (N, 2) best, and how the camera turned if the map's did.

        Points count less whose own places are uncertain across the line of sight.
        """
        points = self.map.points[matched]
        ray = points - pose.position
        squared = (ray**2).sum(axis=1)
        covariance = self._covariance[matched]
        along = np.einsum("ni,nij,nj->n", ray, covariance, ray) / squared
        across = (np.trace(covariance, axis1=1, axis2=2) - along) / (2 * squared)
        sigmas = sigma * np.sqrt(1 + PLACE_VARIANCE * across)
        if self._turn_sd > 0:
            return refine_turning_pose(pose, points, observed, sigmas, self._turn_sd, steps)
        return TurningPose(*refine_pose(pose, points, observed, sigmas, steps), np.zeros(3))

    def _answer(self, refined: TurningPose, inliers: int, visible: int, shown: ShownPoints) -> MapAnswer:
        covariance = np.linalg.pinv(refined.normal, hermitian=True)
        spread = np.maximum(np.diag(covariance), 0.0)
        position_sd, turn_sd_deg = float(np.sqrt(spread[3:].sum())), float(np.degrees(np.sqrt(spread[:3].sum())))
        reason = self._judge(inliers, visible, position_sd, turn_sd_deg)
        return MapAnswer(
            self.given_poses.carry_back(refined.pose, refined.turn),
            refined.pose,
            inliers,
            visible,
            reason,
            position_sd,
            turn_sd_deg,
            covariance,
            shown,
        )

    def _judge(self, inliers: int, visible: int, position_sd: float, orientation_sd_deg: float) -> str:
        """Why a pose is refused; empty if it is accepted."""
        if inliers < ACCEPT_INLIERS or (inliers < SURE_INLIERS and inliers < ACCEPT_SHARE * visible):
            return f"too few guided inliers: {inliers} of {visible} points in view"
        away = position_sd / self._depth
        if inliers < SURE_INLIERS and (away > ACCEPT_SD[0] or orientation_sd_deg > ACCEPT_SD[1]):
            return (
                f"weak geometry: standard deviations of {away:.2g} median depths and {orientation_sd_deg:.2g} degrees"
            )
        return ""

    def _refuse(self, frame: int, reason: str, visible: int = 0) -> MapAnswer:
        frame = self._first if frame < 0 else frame
        given = CameraPose(self.map.given_rotation[frame], self.map.given_position[frame])
        return MapAnswer(given, CameraPose(self.map.rotation[frame], self.map.position[frame]), 0, visible, reason)
