"""Answers: where images were taken, which part of a system says so, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.mapping.map_localizer import MapAnswer, ShownPoints
from lightning_pose.models.parts.error_radius import ErrorRadius
from lightning_pose.models.parts.map_network import MapNetwork
from lightning_pose.models.parts.poses import Pose
from lightning_pose.models.parts.world_frame import WorldFrame

__all__ = ["Answers", "answer_by_map", "answer_by_network", "convert_answers", "localize_prior", "replace_accepted"]

Source = Literal["network", "map", "nearest"]


@dataclass(frozen=True)
class Answers:
    """Camera-to-world poses of M images.

    Attributes:
        position_m: (M, 3), in the scene's unit.
        quat_wxyz: (M, 4), unit.
        source: what each pose comes from: the `network`, the landmark `map`, or where a map alone refuses the image,
            the `nearest` training frame.
        reason: why the map refuses; empty where it accepts, and where there is none.
        excess: (M,), how far an image of a network is from the training images, by the largest distance that is
            accepted: above 1 is refused. nan where that is unknown, and of systems with a map, which decides itself.
        radius_m: (M,), around each position, holds 90 % of errors; nan where it is unknown, inf where refused.
        radius_deg: (M,), the same of orientations.
        inliers: (M,) int64, matches of the map within 3 px; -1 where there is no map.
        visible: (M,) int64, points of the map that the image should show; -1 where there is no map.
        covariance: (M, 6, 6), of x, y, z in the scene's unit and of rotations about the world's axes in rad; nan where
            no map has a pose. It is that of the image errors, scaled until its 90 % spheres are the radii, where these
            are known.
        shown: M, the map's points in each image; None where no map has a pose.
    """

    position_m: np.ndarray
    quat_wxyz: np.ndarray
    source: tuple[Source, ...]
    reason: tuple[str, ...]
    excess: np.ndarray
    radius_m: np.ndarray
    radius_deg: np.ndarray
    inliers: np.ndarray
    visible: np.ndarray
    covariance: np.ndarray
    shown: tuple[ShownPoints | None, ...]

    def __len__(self) -> int:
        return len(self.source)


def answer_by_network(pose: Pose, radius: ErrorRadius | None = None, features: Tensor | None = None) -> Answers:
    """(M,) poses of a network, with what is known of their errors from the features of the images."""
    count = len(pose.position_m)
    radius_m = radius_deg = excess = np.full(count, np.nan)
    if radius is not None and features is not None:
        excess = radius.measure_excess(features).double().numpy()
        radius_m, radius_deg = (np.where(excess > 1, np.inf, radii.numpy()) for radii in radius.find_radii(features))
    none = np.full(count, -1)
    position_m, quat_wxyz = (part.detach().cpu().numpy() for part in pose)
    return Answers(
        position_m,
        quat_wxyz,
        ("network",) * count,
        ("",) * count,
        excess,
        radius_m,
        radius_deg,
        none,
        none,
        np.full((count, 6, 6), np.nan),
        (None,) * count,
    )


def answer_by_map(
    pose: Pose, found: Sequence[MapAnswer], network: MapNetwork, scale: float, refused: Answers | None = None
) -> Answers:
    """(M,) poses, of a map where it accepts.

    Args:
        pose: in the world.
        found: what the map says of the images.
        network: the map.
        scale: of its positions in the scene's unit.
        refused: what holds where the map refuses; by default the map's own guess, with no radius.
    """
    accepted = np.array([answer.accepted for answer in found], bool)
    radius, radius_deg = network.find_radii(list(found))
    radius_m = radius * scale
    covariance = np.array([_turn_covariance(answer, scale, network) for answer in found]).reshape(-1, 6, 6)
    other: tuple[Source, ...] = tuple(answer.source for answer in found)
    if refused is not None:
        other = refused.source
        radius_m, radius_deg = (
            np.where(accepted, of_map, of_other)
            for of_map, of_other in ((radius_m, refused.radius_m), (radius_deg, refused.radius_deg))
        )
        covariance[~accepted] = np.nan  # of a pose that is not the answer
    source: tuple[Source, ...] = tuple("map" if ok else instead for ok, instead in zip(accepted, other, strict=True))
    reason = tuple(answer.reason for answer in found)
    position_m, quat_wxyz = (part.detach().cpu().numpy() for part in pose)
    inliers, visible = (np.array([getattr(answer, name) for answer in found]) for name in ("inliers", "visible"))
    shown = tuple(answer.shown for answer in found)
    unknown = np.full(len(found), np.nan)
    return Answers(
        position_m, quat_wxyz, source, reason, unknown, radius_m, radius_deg, inliers, visible, covariance, shown
    )


SPHERE = 1.4435
"""Radius that holds 90 % of a three-dimensional normal distribution, by the root of the sum of its variances, where
these are equal."""


def _turn_covariance(answer: MapAnswer, scale: float, network: MapNetwork) -> np.ndarray:
    """(6, 6) of position and rotation in the world's axes and unit; nan where the map has no pose.

    Args:
        answer: whose covariance is of a rotation in the camera's axes and a movement in the map's unit.
        scale: of the map's positions in the scene's unit.
        network: the map, with the factors of its radii.
    """
    if answer.covariance is None:
        return np.full((6, 6), np.nan)
    factors = [factor / SPHERE if np.isfinite(factor) else 1.0 for factor in network.calibration.tolist()]
    change = np.zeros((6, 6))
    change[:3, 3:] = np.eye(3) * factors[0] * scale
    change[3:, :3] = answer.pose_in_map.rotation * factors[1]
    return change @ answer.covariance @ change.T


def replace_accepted(pose: Pose, answers: Sequence[MapAnswer], world_frame: WorldFrame) -> Pose:
    """(B,) poses in the world: the map's where it accepts, those given elsewhere."""
    found = convert_answers(answers, world_frame)
    accepted = torch.tensor([[answer.accepted] for answer in answers]).to(pose.position_m.device)
    return Pose(*(torch.where(accepted, new.to(old), old) for new, old in zip(found, pose, strict=True)))


def convert_answers(answers: Sequence[MapAnswer], world_frame: WorldFrame) -> Pose:
    """(B,) poses in the world, float64, of a map's answers, refused ones too."""
    position = np.array([answer.pose.position for answer in answers]).reshape(-1, 3)
    rotation = np.array([answer.pose.rotation for answer in answers]).reshape(-1, 3, 3)
    quats = torch.from_numpy(Rotation.from_matrix(rotation).as_quat(scalar_first=True))
    return Pose(world_frame.to_world(torch.from_numpy(position)), quats)


def localize_prior(prior: CameraPose | None, world_frame: WorldFrame) -> CameraPose | None:
    """A prior in the world as a map takes it."""
    if prior is None:
        return None
    return CameraPose(prior.rotation, world_frame.to_local(torch.from_numpy(prior.position)).numpy())
