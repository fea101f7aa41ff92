"""Whether a dataset's poses fit its images: what `check` proves from matches between nearby frames."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.errors import ImageError
from lightning_pose.features.surf.numpy_surf import extract_surf
from lightning_pose.geometry.camera import Camera
from lightning_pose.geometry.triangulation import find_two_view_depths
from lightning_pose.mapping.clock_offset import MAX_OFFSET_S, STEP_S, fit_clock_offset
from lightning_pose.mapping.conventions import AS_READ, MATCHES_TO_RANK, Reading, rank_readings
from lightning_pose.mapping.frame_matches import FrameMatches, match_nearby_frames
from lightning_pose.scenes.images import read_gray
from lightning_pose.scenes.scene import Intrinsics, Scene

__all__ = ["PoseCheck", "check_poses"]

LONGEST_PX = 960
"""Larger images are shrunk to this before features are extracted."""

MOST_FEATURES = 300
"""SURF keypoints of an image, the strongest."""

MIN_PAIRS = 10
"""Fewer pairs of frames with a baseline prove nothing."""

BETTER = 0.5
"""Another reading is proposed if its cost is below this share of the files' own."""

FITS = 0.004
"""Poses fit the images if the median match lies this near to its epipolar line, in image widths: 2.6 px of 640."""

FOCAL_TOLERANCE = 0.1
"""A known focal length farther than this share from the fitted one is reported."""

PLAUSIBLE_DEPTH_M = (0.05, 150.0)
"""Median distance of what the cameras see, where positions are in metres."""

WORLD_TO_CAMERA_FORMATS = ("cambridge", "colmap")
"""Formats whose files hold world-to-camera quaternions, so that a wrong order is one of those."""

CLEARER = 0.9
"""Poses of another time are proposed if their cost and their residual are below this share of those as given."""

MIN_OFFSET_S = 0.005
"""Smaller offsets between clocks are not reported: images are exposed for that long."""

FAR_CLOCK = 2.0, 0.02
"""Offset in seconds, and step, of the search where poses do not fit at their times."""

FEW_FEATURES = 25
"""Fewer features in an image, and too little of it can be matched."""

MIN_PARALLAX_DEG = 0.5
"""Rays of a match must differ by this much for its depth to count."""


@dataclass
class PoseCheck:
    """What matches between nearby frames prove.

    Attributes:
        facts: by their names, for an overview.
        errors: what spoils a training.
        warnings: what may be meant.
        readings: all readings of the poses, best first; empty where too little could be matched.
        focal_px: the focal length that fits best, in pixels of the images as they are; nan if unknown.
    """

    facts: dict[str, str] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    readings: list[Reading] = field(default_factory=list)
    focal_px: float = np.nan


def check_poses(scene: Scene) -> PoseCheck:
    """Match nearby frames, and see under which reading of the poses the matches lie on epipolar lines.

    Images that cannot be read are passed over.

    Args:
        scene: the dataset, as it was read.
    """
    found = PoseCheck()
    looked_at: dict[int, tuple[int, tuple[int, int], float]] = {}  # frame: keypoints, size, and how much it was shrunk

    def read_keypoints(frame: int) -> tuple[np.ndarray, np.ndarray]:
        try:
            image = read_gray(scene.frames[frame].image)
        except ImageError:
            return np.zeros((0, 2)), np.zeros((0, 64), np.float32)
        size = image.shape[1], image.shape[0]
        scale = min(1.0, LONGEST_PX / max(size))
        if scale < 1:
            image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        keypoints, descriptors = extract_surf(image, MOST_FEATURES, upright=True, threshold=0.0)  # torch takes seconds
        looked_at[frame] = len(keypoints), size, scale
        pixels = (keypoints[:, :2] + 0.5) / scale - 0.5
        points = _undistort_points(pixels, scene.frames[frame].intrinsics, *size) * scale
        return points, descriptors

    sequences = [frame.sequence for frame in scene.frames]
    matches = match_nearby_frames(sequences, read_keypoints, threads=os.cpu_count() or 1)
    _judge_features(found, [count for count, _, _ in looked_at.values()])
    quats = np.array([frame.quat_wxyz for frame in scene.frames])
    rotation = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    position = np.array([frame.position_m for frame in scene.frames])
    moved = np.linalg.norm(position[matches.frame_a] - position[matches.frame_b], axis=1) > 0
    if moved.sum() < MIN_PAIRS:
        found.facts["poses and images"] = f"not compared: only {moved.sum()} pairs of frames match and move"
        return found
    _, size, scale = looked_at[min(looked_at)]
    width_px = max(size) * scale
    found.readings = rank_readings(matches, rotation, position, width_px, scene.format in WORLD_TO_CAMERA_FORMATS)
    _judge_readings(found, scale, len(matches.pair), FITS * width_px)
    _judge_focal_length(found, scene, size)
    _judge_clock(found, scene, matches, scale, FITS * width_px)
    _judge_depth(found, scene, matches, rotation, position, found.focal_px * scale)
    return found


def _undistort_points(pixels: np.ndarray, known: Intrinsics | None, width: int, height: int) -> np.ndarray:
    """Pixels from the principal point, (N, 2), without distortion; of an unknown camera, from the image's centre."""
    if known is None:
        return pixels - (np.array([width, height]) - 1) / 2
    known = known.for_size(width, height)
    camera = Camera(width, height, known.fx, known.fx, known.cx, known.cy, known.distortion, known.fisheye)
    return camera.normalize(pixels) * known.fx


def _judge_features(found: PoseCheck, counts: list[int]) -> None:
    """How many features images have, and how many have too few of them."""
    if not counts:
        return
    found.facts["features per frame"] = (
        f"median {np.median(counts):.0f}, least {min(counts)}, of at most {MOST_FEATURES} SURF keypoints "
        f"({len(counts)} frames)"
    )
    few = sum(count < FEW_FEATURES for count in counts)
    if few:
        found.warnings.append(
            f"{few} of {len(counts)} images that were looked at have fewer than {FEW_FEATURES} features; leave out "
            "blank, covered and dark images, or take larger ones"
        )


def _judge_clock(found: PoseCheck, scene: Scene, matches: FrameMatches, scale: float, fits_px: float) -> None:
    """Whether the poses fit the images better at other times than their own."""
    times = [frame.timestamp for frame in scene.frames if frame.timestamp is not None]
    if scene.trajectory is None or len(times) < len(scene.frames) or found.errors:
        return
    times_s, focal_px = np.array(times), found.focal_px * scale
    best = fit_clock_offset(matches, times_s, scene.trajectory, focal_px)
    if best is None or best.residual_px > fits_px or abs(best.offset_s) > MAX_OFFSET_S - STEP_S:
        few = matches.sample(MATCHES_TO_RANK)
        best = fit_clock_offset(few, times_s, scene.trajectory, focal_px, *FAR_CLOCK) or best
    if best is None or best.residual_px > fits_px:
        return
    shift = f"{best.residual_px / scale:.2f} px at {1000 * best.offset_s:+.0f} ms"
    found.facts["clock of the poses"] = f"{shift}, {best.residual_at_zero_px / scale:.2f} px as given"
    clearer = best.cost < CLEARER * best.cost_at_zero and best.residual_px < CLEARER * best.residual_at_zero_px
    if clearer and abs(best.offset_s) >= MIN_OFFSET_S:
        verb, prep = ("subtract", "from") if best.offset_s > 0 else ("add", "to")
        found.warnings.append(
            f"the poses fit the images better at other times ({shift}, {best.residual_at_zero_px / scale:.2f} px as "
            f"given), so that the clocks of images and poses differ; {verb} {abs(best.offset_s):.3f} s {prep} the "
            "times of the poses"
        )


def _judge_readings(found: PoseCheck, scale: float, n_matches: int, fits_px: float) -> None:
    as_read = next(reading for reading in found.readings if reading.name == AS_READ)
    best = found.readings[0]
    found.focal_px = best.focal_px / scale
    others = [reading for reading in found.readings if reading.name != AS_READ]
    found.facts["poses and images"] = (
        f"{n_matches} matches lie {as_read.residual_px / scale:.2f} px (median) off their epipolar lines; "
        f"the next best reading, {others[0].name}: {others[0].residual_px / scale:.2f} px"
    )
    if best is not as_read and best.cost < BETTER * as_read.cost and best.residual_px < fits_px:
        found.errors.append(
            f"the poses fit the images far better if the files hold: {best.name} ({best.residual_px / scale:.2f} px "
            f"against {as_read.residual_px / scale:.2f} px as read); convert the pose files, or set data.format"
        )
    elif as_read.residual_px > fits_px:
        found.warnings.append(
            f"the poses do not fit the images under any usual convention (at best {best.residual_px / scale:.2f} px, "
            f"read as: {best.name}); check that each image has its own pose, and the clock of the poses"
        )


def _judge_focal_length(found: PoseCheck, scene: Scene, size: tuple[int, int]) -> None:
    known = scene.frames[0].intrinsics
    known = None if known is None else known.for_size(*size)
    about = f"{found.focal_px:.0f} px fits the poses best"
    found.facts["focal length"] = about if known is None else f"{about}; the dataset has {known.fx:.0f} px"
    if known is not None and not found.errors and abs(found.focal_px / known.fx - 1) > FOCAL_TOLERANCE:
        found.warnings.append(
            f"the dataset's focal length is {known.fx:.0f} px, and {about}; check the calibration and the image size"
        )


def _judge_depth(
    found: PoseCheck, scene: Scene, matches: FrameMatches, rotation: np.ndarray, position: np.ndarray, focal_px: float
) -> None:
    """The distance of what the cameras see, which shows a wrong unit of the positions."""
    a, b = matches.frame_a[matches.pair], matches.frame_b[matches.pair]
    to_a = np.swapaxes(rotation[a], 1, 2)
    turn, shift = to_a @ rotation[b], np.einsum("mij,mj->mi", to_a, position[b] - position[a])
    points_a, points_b = matches.points_a_px / focal_px, matches.points_b_px / focal_px
    depth = find_two_view_depths(points_a, points_b, turn, shift)
    baseline = np.linalg.norm(shift, axis=1)
    clear = (depth > 0) & (baseline > np.radians(MIN_PARALLAX_DEG) * depth)
    if clear.sum() < MIN_PAIRS or found.errors:
        return
    median = float(np.median(depth[clear]))
    found.facts["distance of what is seen"] = f"median {median:.3g} {scene.unit}"
    low, high = PLAUSIBLE_DEPTH_M
    if scene.unit == "m" and not low <= median <= high:
        unit = "millimetres or centimetres" if median > high else "kilometres, or scaled"
        found.warnings.append(
            f"the cameras see things at {median:.3g} m (median), which is implausible; if the positions are in "
            f"{unit}, convert them to metres, or errors in metres mean nothing"
        )
