"""Shapes in signatures are checked while tests run, and not in use."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from lightning_pose.geometry.quaternions import mean_quat, orientation_error_deg, quat_multiply, quat_normalize
from lightning_pose.geometry.relative import Chain, relative_poses
from lightning_pose.geometry.two_view import two_view_motion
from lightning_pose.losses import PoseLoss

QUATS = torch.tensor([1.0, 0, 0, 0]).expand(5, 4)


def test_a_wrong_last_dimension_is_refused() -> None:
    with pytest.raises(TypeCheckError, match="parameter 'quat_wxyz'"):
        quat_normalize(torch.zeros(5, 3))
    with pytest.raises(TypeCheckError, match="parameter 'position_hat'"):
        PoseLoss()(torch.zeros(5, 4), QUATS, torch.zeros(5, 3), QUATS)


def test_integers_are_refused() -> None:
    with pytest.raises(TypeCheckError, match="parameter 'quat_wxyz'"):
        quat_normalize(torch.ones(4, dtype=torch.int64))


def test_batches_that_differ_are_refused() -> None:
    with pytest.raises(TypeCheckError, match="parameter 'quat_wxyz'"):
        relative_poses(torch.zeros(4, 3), QUATS)
    with pytest.raises(TypeCheckError, match="parameter 'weights'"):
        mean_quat(QUATS, torch.ones(4))
    with pytest.raises(TypeCheckError, match="parameter 'points_b'"):
        two_view_motion(np.zeros((20, 2)), np.zeros((19, 2)), 500.0)
    with pytest.raises(TypeCheckError, match="parameter 'quat_wxyz'"):
        Chain().add([0, 1], torch.zeros(2, 3), QUATS)


def test_only_batches_that_broadcast_are_taken() -> None:
    assert orientation_error_deg(QUATS[:, None], QUATS[:2]).shape == (5, 2)
    with pytest.raises(TypeCheckError, match="parameter 'b'"):
        quat_multiply(QUATS, QUATS[:2])


def test_commands_that_need_no_torch_do_not_import_jaxtyping() -> None:
    code = "import sys, lightning_pose, lightning_pose.commands.check; sys.exit('jaxtyping' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_nothing_is_checked_outside_of_tests() -> None:
    code = (
        "import sys, torch; from lightning_pose.geometry.quaternions import quat_normalize;"
        "quat_normalize(torch.ones(2, 4, dtype=torch.float64)); sys.exit('beartype' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
