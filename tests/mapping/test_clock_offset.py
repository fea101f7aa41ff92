"""The offset between the clocks of images and poses is found from matches of a synthetic camera, to milliseconds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.mapping.clock_offset import fit_clock_offset
from lightning_pose.mapping.frame_matches import FrameMatches
from lightning_pose.scenes.scene import Trajectory

FOCAL_PX = 500.0
RATE_HZ = 100.0


def move_camera(times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N, 3, 3) and positions (N, 3) of a hand-held camera at some times."""
    t = times_s[:, None]
    angles = 0.3 * np.sin(t * [2.0, 3.1, 1.7] + [0.0, 1.0, 2.0])
    return Rotation.from_euler("xyz", angles).as_matrix(), 0.3 * np.sin(t * [1.9, 2.3, 1.3] + [1.0, 0.0, 2.0])


def make_recording(offset_s: float) -> tuple[FrameMatches, np.ndarray, Trajectory]:
    """Matches of 60 frames at 10 Hz, and a trajectory whose clock is ahead by the offset."""
    rng = np.random.default_rng(0)
    frame_s = 1.0 + 0.1 * np.arange(60)
    points = rng.uniform([-2, -2, 2], [2, 2, 5], (40, 3))
    rotation, position = move_camera(frame_s)
    local = np.einsum("fji,fnj->fni", rotation, points[None] - position[:, None])
    pixels = FOCAL_PX * local[..., :2] / local[..., 2:] + rng.normal(0, 0.3, (60, 40, 2))
    a, b = np.arange(0, 55), np.arange(5, 60)
    pair = np.repeat(np.arange(55), 40)
    matches = FrameMatches(a, b, pair, pixels[a].reshape(-1, 2), pixels[b].reshape(-1, 2))
    pose_s = np.arange(0, 9, 1 / RATE_HZ)
    rotation, position = move_camera(pose_s)
    quats = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    return matches, frame_s, Trajectory(pose_s + offset_s, position, quats)


@pytest.mark.parametrize("offset_s", [0.0, 0.05, -0.12])
def test_the_offset_is_found(offset_s: float) -> None:
    best = fit_clock_offset(*make_recording(offset_s), FOCAL_PX)
    assert best is not None
    assert best.offset_s == pytest.approx(offset_s, abs=0.004)
    assert best.residual_px < 0.5
    if offset_s:
        assert best.residual_at_zero_px > 3 * best.residual_px


def test_an_offset_of_seconds_is_found_in_a_wider_search() -> None:
    best = fit_clock_offset(*make_recording(0.9), FOCAL_PX, max_offset_s=1.0, step_s=0.02)
    assert best is not None
    assert best.offset_s == pytest.approx(0.9, abs=0.008)


def test_a_trajectory_of_another_day_says_nothing() -> None:
    matches, frame_s, trajectory = make_recording(0.0)
    assert fit_clock_offset(matches, frame_s + 1e6, trajectory, FOCAL_PX) is None
    assert fit_clock_offset(matches, frame_s, Trajectory(*(part[:1] for part in trajectory)), FOCAL_PX) is None
