"""LocatedPose: where one image was taken, how sure the answer is, and what was done to the image."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

__all__ = ["JsonValue", "LocatedPose", "describe_excess", "refuse_image", "stack_poses"]

JsonValue = str | float | int | None | list["JsonValue"] | dict[str, "JsonValue"]
"""What a JSON file can hold."""


@dataclass(frozen=True, eq=False)
class LocatedPose:
    """A camera-to-world pose in the world of the training data, OpenCV axes, of the pixels as stored in the file.

    A refused pose is the best guess that there is: of the network beside a map, else of too few inliers, else of the
    most similar training frame; `source` says which.
    An image that cannot be read has none: its numbers are nan.

    Attributes:
        position_m: (3,) float64, the camera's centre in the scene's unit.
        quat_wxyz: (4,) float64, unit, camera-to-world.
        status: `accepted`, or `refused`. Systems without a map refuse blank images, and those that are too far from the
            training images in the features (`distance_limit`).
        reason: why it is refused; empty if it is accepted.
        source: what the pose comes from: the landmark `map`, the `network`, or the `nearest` training frame;
            `none` if the image cannot be read.
        radius_m: holds 90 % of position errors, in the scene's unit; nan if unknown, inf if refused with no radius.
        radius_deg: the same of orientation errors, in degrees.
        covariance: (6, 6) float64: x, y, z in the scene's unit, then rotations about the world's x, y and z in rad, as
            ROS's `PoseWithCovariance` has it. None if there is no map, or it refused before it had a pose. It is that
            of the image errors, scaled until its 90 % spheres are the radii, where these are known.
        inliers: matches of the map within 3 pixels; None without a map.
        visible: points of the map that the image should show; None without a map.
        milliseconds: what each stage took: `read`, `features`, `locate`, and `total`.
        image: name of the image: its path as given, `VIDEO#FRAME`, or None for an array.
        time_s: of a video's frame, from its beginning; None for an image.
        notes: what was done to the image, such as turned by its EXIF orientation.
        inliers_px: (K, 2) float32, where the map's inliers are in the image; None without. Not in `to_dict`.

    >>> pose = LocatedPose(np.zeros(3), np.array([1.0, 0, 0, 0]), radius_m=0.02)
    >>> pose.accepted, pose.T_world_cam.shape
    (True, (4, 4))
    >>> pose.to_dict()["radius_m"], pose.to_dict()["radius_deg"]
    (0.02, None)
    """

    position_m: np.ndarray
    quat_wxyz: np.ndarray
    status: Literal["accepted", "refused"] = "accepted"
    reason: str = ""
    source: Literal["map", "network", "nearest", "none"] = "network"
    radius_m: float = math.nan
    radius_deg: float = math.nan
    covariance: np.ndarray | None = None
    inliers: int | None = None
    visible: int | None = None
    milliseconds: Mapping[str, float] = field(default_factory=dict)
    image: str | None = None
    time_s: float | None = None
    notes: tuple[str, ...] = ()
    inliers_px: np.ndarray | None = field(default=None, repr=False)

    @property
    def accepted(self) -> bool:
        """Whether the status is `accepted`."""
        return self.status == "accepted"

    @property
    def T_world_cam(self) -> np.ndarray:  # noqa: N802  # the field's name for it
        """(4, 4) float64: a point in the camera's axes, times this matrix, is the point in the world."""
        w, x, y, z = self.quat_wxyz
        matrix = np.eye(4)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, 3] = self.position_m
        return matrix

    def to_dict(self) -> dict[str, JsonValue]:
        """All attributes and `T_world_cam` in plain types, as JSON has them; numbers that are not finite are None."""
        return {
            "image": self.image,
            "time_s": self.time_s,
            "status": self.status,
            "reason": self.reason,
            "source": self.source,
            "position_m": _list_numbers(self.position_m),
            "quat_wxyz": _list_numbers(self.quat_wxyz),
            "T_world_cam": [_list_numbers(row) for row in self.T_world_cam],
            "radius_m": _finite_or_none(self.radius_m),
            "radius_deg": _finite_or_none(self.radius_deg),
            "covariance": None if self.covariance is None else [_list_numbers(row) for row in self.covariance],
            "inliers": self.inliers,
            "visible": self.visible,
            "milliseconds": {name: _finite_or_none(value) for name, value in self.milliseconds.items()},
            "notes": list(self.notes),
        }


def _finite_or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _list_numbers(values: np.ndarray) -> list[JsonValue]:
    return [_finite_or_none(value) for value in values]


def stack_poses(poses: Sequence[LocatedPose]) -> tuple[np.ndarray, np.ndarray]:
    """`position_m` (M, 3) and `quat_wxyz` (M, 4) of M poses, float64.

    >>> stack_poses([LocatedPose(np.ones(3), np.array([1.0, 0, 0, 0]))])[0].tolist()
    [[1.0, 1.0, 1.0]]
    """
    position_m = np.array([pose.position_m for pose in poses], np.float64).reshape(-1, 3)
    return position_m, np.array([pose.quat_wxyz for pose in poses], np.float64).reshape(-1, 4)


def describe_excess(excess: float) -> str:
    """Why a network refuses an image, from its distance to the training images by the largest accepted; nan: unknown.

    >>> describe_excess(1.84), describe_excess(0.7), describe_excess(math.nan)
    ('unlike the training images: 1.84 times the distance limit', '', '')
    """
    return f"unlike the training images: {excess:.2f} times the distance limit" if excess > 1 else ""


def refuse_image(image: str | None, reason: str) -> LocatedPose:
    """The answer for an image that cannot be read: no pose, and the reason.

    >>> refuse_image("a.jpg", "a.jpg is empty").to_dict()["position_m"]
    [None, None, None]
    """
    nowhere = np.full(7, np.nan)
    return LocatedPose(
        nowhere[:3], nowhere[3:], "refused", reason, "none", radius_m=math.inf, radius_deg=math.inf, image=image
    )
