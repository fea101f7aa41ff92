"""Writes a finished reconstruction as a COLMAP scene, in metres where these are known, and sums it up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
import pycolmap

from lightning_pose.reconstruction.alignment import KnownDistance, align_positions, scale_to_distance
from lightning_pose.reconstruction.diagnosis import describe_rows
from lightning_pose.reconstruction.pipeline import PosedFrames
from lightning_pose.reconstruction.workspace import Workspace, write_json

__all__ = ["Summary", "make_metric", "write_scene"]


@dataclass(frozen=True)
class Summary:
    """What a reconstruction has found, as `reconstruction.json` has it.

    Attributes:
        unit: `m`, or `scene` where the scale is arbitrary.
        frames: how many were chosen.
        posed: how many have a pose.
        points: how many there are.
        reprojection_px: mean distance of points from the keypoints that see them.
        extent: of the camera centres, the longest side of the box around them.
        cameras: in COLMAP's notation.
        residuals_m: how far known positions are off after the alignment, by image.
        seconds: how long each step of this call took.
        without_pose: frames without a pose, in words.
        reasons: why they have none, and what else is wrong.
    """

    unit: str
    frames: int
    posed: int
    points: int
    reprojection_px: float
    extent: float
    cameras: list[str]
    residuals_m: dict[str, float]
    seconds: dict[str, float]
    without_pose: str
    reasons: list[str]

    def list_lines(self) -> list[str]:
        """The summary in words."""
        unit = "m" if self.unit == "m" else "units"
        lines = [
            f"{self.posed} of {self.frames} frames have a pose; {self.points} points, {self.reprojection_px:.2f} px "
            f"from their keypoints on average; the cameras span {self.extent:.3g} {unit}"
        ]
        lines += [f"camera: {camera}" for camera in self.cameras]
        if self.residuals_m:
            errors = np.array(list(self.residuals_m.values()))
            worst = max(self.residuals_m, key=lambda name: self.residuals_m[name])
            lines.append(
                f"{len(errors)} known positions are off by {np.median(errors):.3f} m (median), at most "
                f"{errors.max():.3f} m ({worst})"
            )
        if self.unit != "m":
            lines.append('the unit of length is arbitrary; --scale "A B METRES" or --align makes it metres')
        if self.without_pose:
            lines.append(f"warning: without a pose: {self.without_pose}")
        lines += [f"warning: {text}" for text in self.reasons]
        return lines


def make_metric(
    found: PosedFrames, distance: KnownDistance | None, known: Mapping[str, np.ndarray]
) -> dict[str, float] | None:
    """Scale or move a model into metres.

    Returns:
        how far each known position is off, in metres, by image; empty for a known distance; None if neither is known.

    Raises:
        DataError: frames that are known have no pose, or do not fix the similarity.
    """
    if distance is None and not known:
        return None
    residuals: dict[str, float] = {}
    if distance is not None:
        similarity = scale_to_distance(distance, found.list_centres())
    else:
        similarity, residuals = align_positions(known, found.list_centres())
    rotation = pycolmap.Rotation3d(similarity.rotation)
    found.model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.shift))
    return residuals


def write_scene(
    workspace: Workspace, found: PosedFrames, residuals: dict[str, float] | None, seconds: dict[str, float]
) -> Summary:
    """Write the model into `sparse/0`, with colours, and `reconstruction.json`.

    Args:
        workspace: where.
        found: the model, in its unit.
        residuals: of `make_metric`; None if the unit is arbitrary.
        seconds: how long each step took, by its name.
    """
    model = found.model
    model.update_point_3d_errors()
    model.extract_colors_for_all_images(workspace.images)
    workspace.model.mkdir(parents=True, exist_ok=True)
    model.write(workspace.model)
    centres = np.array(list(found.list_centres().values()))
    left = set(range(len(found.names))) - set(found.posed)
    summary = Summary(
        unit="scene" if residuals is None else "m",
        frames=len(found.names),
        posed=len(found.posed),
        points=model.num_points3D(),
        reprojection_px=model.compute_mean_reprojection_error(),
        extent=float(np.ptp(centres, axis=0).max()),
        cameras=[_describe_camera(camera) for camera in model.cameras.values()],
        residuals_m=residuals or {},
        seconds={step: round(value, 2) for step, value in seconds.items()},
        without_pose=describe_rows(left, found.names),
        reasons=list(found.reasons),
    )
    write_json(workspace.summary, asdict(summary))
    return summary


def _describe_camera(camera: pycolmap.Camera) -> str:
    """A camera in COLMAP's notation, with pixels counted from the corner of the first one."""
    return ",".join(
        [camera.model_name, f"{camera.width},{camera.height}", *(f"{value:.6g}" for value in camera.params)]
    )
