"""Evaluation of a landmark map beside its errors: acceptance, coverage of its radii, and figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from lightning_pose.data.batches import PoseBatch
from lightning_pose.figures import maps as map_figures
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m
from lightning_pose.mapping.map_localizer import MapAnswer
from lightning_pose.metrics.summary import summarize_errors
from lightning_pose.models.landmark_map import LandmarkMap
from lightning_pose.scenes.scene import Scene

__all__ = ["MapEvaluation", "evaluate_map"]


@dataclass
class MapEvaluation:
    """Results of a test that only a map has.

    Attributes:
        metrics: `test/NAME` of `catalog.MAP`; only what is known.
        rows: metrics over the accepted frames alone, by the row's name in the printed table.
        figures: by file name.
    """

    metrics: dict[str, float]
    rows: Mapping[str, Mapping[str, float]]
    figures: dict[str, Figure]


@torch.inference_mode()
def evaluate_map(module: LandmarkMap, scene: Scene, test: PoseBatch) -> MapEvaluation:
    """Locate test frames again: `test_step` returned their poses, without inliers, refusals and radii.

    Args:
        module: with a map.
        scene: of the frames.
        test: the frames that were tested, with poses in the world.
    """
    answers = module.locate_frames(test)
    truth_m = test.position_m.double().numpy()
    found_m = to_world(module, np.array([answer.pose.position for answer in answers]))
    position = position_error_m(torch.from_numpy(found_m), torch.from_numpy(truth_m)).numpy()
    orientation = orientation_error_deg(torch.from_numpy(stack_quats(answers)), test.quat_wxyz.double()).numpy()
    accepted = np.array([answer.accepted for answer in answers])
    radius, radius_deg = module.network.find_radii(answers)
    radius_m = radius * module.world_frame.scale
    metrics = {"test/accepted": float(accepted.mean())}
    rows: dict[str, Mapping[str, float]] = {}
    if accepted.any():
        held = summarize_errors(position[accepted], orientation[accepted])
        rows[f"of these {accepted.mean():.0%} accepted"] = held
        metrics["test/accepted_position_median_m"] = held["position_median_m"]
        metrics["test/accepted_orientation_median_deg"] = held["orientation_median_deg"]
    if accepted.any() and np.isfinite(radius_m[accepted]).all():
        metrics["test/coverage_position"] = float((position <= radius_m)[accepted].mean())
        metrics["test/coverage_orientation"] = float((orientation <= radius_deg)[accepted].mean())
        metrics["test/radius_median_m"] = float(np.median(radius_m[accepted]))
        metrics["test/radius_median_deg"] = float(np.median(radius_deg[accepted]))
    point_map = module.network.point_map
    about = f"LandmarkMap on {scene.name}"
    figures = {
        "map": map_figures.draw_map(
            to_world(module, point_map.points),
            to_world(module, point_map.given_position),
            truth_m,
            found_m,
            accepted,
            title=about,
            unit=scene.unit,
        ),
        "error_vs_inliers": map_figures.draw_error_vs_inliers(
            position, np.array([answer.inliers for answer in answers]), accepted, title=about, unit=scene.unit
        ),
    }
    if "test/coverage_position" in metrics:
        figures["calibration"] = map_figures.draw_calibration(
            (position[accepted], orientation[accepted]),
            (radius_m[accepted], radius_deg[accepted]),
            title=about,
            unit=scene.unit,
        )
    return MapEvaluation(metrics, rows, figures)


def to_world(module: LandmarkMap, position: np.ndarray) -> np.ndarray:
    """(N, 3) positions of the map in the world."""
    return module.world_frame.to_world(torch.from_numpy(position)).numpy()


def stack_quats(answers: list[MapAnswer]) -> np.ndarray:
    """(N, 4) wxyz of the answers' poses."""
    rotations = np.array([answer.pose.rotation for answer in answers])
    return Rotation.from_matrix(rotations).as_quat(scalar_first=True)
