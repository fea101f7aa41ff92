"""Evaluation of a landmark map beside its errors: acceptance, coverage of its radii, and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.figure import Figure

from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.datamodule import SceneDataModule
from lightning_pose.figures import maps as map_figures
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m
from lightning_pose.mapping.map_localizer import MapAnswer
from lightning_pose.metrics.catalog import MEDIANS
from lightning_pose.metrics.summary import summarize_errors
from lightning_pose.models.base import Pose
from lightning_pose.models.parts.frame_cameras import list_cameras
from lightning_pose.models.parts.map_network import MapNetwork
from lightning_pose.models.parts.world_frame import WorldFrame
from lightning_pose.scenes.images import read_rgb
from lightning_pose.scenes.scene import Scene

__all__ = ["MapEvaluation", "draw_examples", "evaluate_map", "measure_accepted", "measure_coverage"]

EXAMPLE_RANKS = (0.0, 0.5, 0.9, 1.0)
"""Of errors, at which test frames are shown."""

Errors = tuple[np.ndarray, np.ndarray]
"""Of positions (N,) in the scene's unit, and of orientations (N,) in degrees."""


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
def evaluate_map(
    network: MapNetwork,
    answers: Sequence[MapAnswer],
    world_frame: WorldFrame,
    prediction: Pose,
    scene: Scene,
    test: PoseBatch,
    name: str,
) -> MapEvaluation:
    """Evaluate what a map says of test frames beside the poses that they got.

    Args:
        network: with a map.
        answers: of the map for the test frames.
        world_frame: of the map.
        prediction: poses of the test frames in the world.
        scene: of the frames.
        test: the frames that were tested, with poses in the world.
        name: of the system.
    """
    truth_m = test.position_m.double().numpy()
    found_m = prediction.position_m.double().numpy()
    position = position_error_m(torch.from_numpy(found_m), torch.from_numpy(truth_m)).numpy()
    orientation = orientation_error_deg(prediction.quat_wxyz.double(), test.quat_wxyz.double()).numpy()
    accepted = np.array([answer.accepted for answer in answers])
    radius, radius_deg = network.find_radii(list(answers))
    radius_m = radius * world_frame.scale
    metrics, rows = measure_accepted((position, orientation), accepted)
    found = measure_coverage((position[accepted], orientation[accepted]), (radius_m[accepted], radius_deg[accepted]))
    metrics |= found
    about = f"{name} on {scene.name}"
    point_map = network.point_map
    points, training = (world_frame.to_world(torch.from_numpy(each)).numpy() for each in (
        point_map.points, point_map.given_position,
    ))  # fmt: skip
    figures = {
        "map": map_figures.draw_map(points, training, truth_m, found_m, accepted, title=about, unit=scene.unit),
        "error_vs_inliers": map_figures.draw_error_vs_inliers(
            position, np.array([answer.inliers for answer in answers]), accepted, title=about, unit=scene.unit
        ),
    }
    if found:
        figures["calibration"] = map_figures.draw_calibration(
            (position[accepted], orientation[accepted]),
            (radius_m[accepted], radius_deg[accepted]),
            title=about,
            unit=scene.unit,
        )
    return MapEvaluation(metrics, rows, figures)


def draw_examples(
    network: MapNetwork,
    answers: Sequence[MapAnswer],
    prediction: Pose,
    test: PoseBatch,
    datamodule: SceneDataModule,
    name: str,
) -> dict[str, Figure]:
    """Four test frames with the points of the map in them, by rank of their position error; nothing if all are refused.

    Args:
        network: with a map.
        answers: of the map for the test frames.
        prediction: poses of the test frames in the world.
        test: the frames that were tested.
        datamodule: of the frames.
        name: of the system.
    """
    error_m = position_error_m(prediction.position_m.double(), test.position_m.double()).numpy()
    order = [int(i) for i in np.argsort(error_m, kind="stable") if answers[int(i)].shown is not None]
    if not order:
        return {}
    ranks = {f"{rank:.0%} of errors are smaller": order[round(rank * (len(order) - 1))] for rank in EXAMPLE_RANKS}
    correction, scene = network.point_map.camera_correction, datamodule.scene
    images = []
    for caption, row in ranks.items():
        answer, frame = answers[row], int(test.frame[row])
        (camera,) = list_cameras(datamodule, [frame], network.view)
        shown = answer.shown
        assert shown is not None, "chosen for it"
        seen, projected, observed = (camera.project(correction.distort(each)) for each in shown[:3])
        about = f"{caption}: {error_m[row]:.3g} {scene.unit}, {answer.reason or 'accepted'}"
        pixels = read_rgb(scene.frames[frame].image)
        images.append(map_figures.MatchedImage(pixels, seen, projected, observed, shown.inlier, about))
    return {"matched_images": map_figures.draw_matched_images(images, f"{name} on {scene.name}, test frames")}


def measure_accepted(errors: Errors, accepted: np.ndarray) -> tuple[dict[str, float], dict[str, Mapping[str, float]]]:
    """Metrics of the accepted (N,) of all frames, and a row of theirs for the printed table; no row without any."""
    metrics = {"test/accepted": float(accepted.mean())}
    if not accepted.any():
        return metrics, {}
    held = summarize_errors(*(error[accepted] for error in errors))
    metrics |= {f"test/accepted_{name}": held[name] for name in MEDIANS}
    return metrics, {f"of these {accepted.mean():.0%} accepted": held}


def measure_coverage(errors: Errors, radii: Errors) -> dict[str, float]:
    """How many of (N,) errors lie within their radii, and the median radii; nothing where radii are unknown."""
    if not len(errors[0]) or not np.isfinite(radii).all():
        return {}
    inside = [float((error <= radius).mean()) for error, radius in zip(errors, radii, strict=True)]
    names = ("coverage_position", "coverage_orientation", "radius_median_m", "radius_median_deg")
    values = (*inside, *(float(np.median(radius)) for radius in radii))
    return {f"test/{name}": value for name, value in zip(names, values, strict=True)}
