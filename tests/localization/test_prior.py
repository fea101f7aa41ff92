"""Priors: where a camera is thought to be helps a map, and is checked against it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import ConfigError
from lightning_pose.localization.localizer import Localizer
from tests.helpers import Trained
from tests.rooms import MappedRoom


@pytest.fixture(scope="module")
def localizer(mapped_room: MappedRoom) -> Localizer:
    return Localizer.load(mapped_room.checkpoint)


def test_a_near_prior_changes_little(localizer: Localizer, mapped_room: MappedRoom) -> None:
    alone = localizer.localize(mapped_room.images[4])
    near = mapped_room.position_m[4] + [0.05, 0, 0.05], mapped_room.quat_wxyz[4]
    for prior in (alone, near):
        pose = localizer.localize(mapped_room.images[4], prior=prior)
        assert pose.status == "accepted"
        np.testing.assert_allclose(pose.position_m, alone.position_m, atol=0.01)


def test_a_prior_that_contradicts_is_a_refusal(localizer: Localizer, mapped_room: MappedRoom) -> None:
    far = mapped_room.position_m[4] + [0, 0, 5.0], mapped_room.quat_wxyz[4]
    pose = localizer.localize(mapped_room.images[4], prior=far)
    assert pose.status == "refused"
    assert pose.reason.startswith("contradicts the prior: ")
    assert pose.source == "map"  # it is a pose of the map, although it is not believed
    assert math.isinf(pose.radius_m)


@pytest.mark.parametrize(
    "prior", [3, (np.zeros(3), np.zeros(4)), (np.zeros(2), np.ones(4)), (np.zeros(3), [np.nan] * 4)]
)
def test_what_is_no_prior(prior: object, localizer: Localizer, mapped_room: MappedRoom) -> None:
    with pytest.raises(ConfigError, match="prior is no pose; give an earlier answer"):
        localizer.localize(mapped_room.images[0], prior=prior)  # pyright: ignore[reportCallIssue, reportArgumentType]


def test_networks_refuse_cameras_and_priors(trained: Trained, scene: Path) -> None:
    localizer, image = Localizer.load(trained.best, allow="tests"), next((scene / "seq-03").glob("*.png"))
    with pytest.raises(ConfigError, match="SurfLSTM does not use cameras; leave camera out"):
        localizer.localize(image, camera="PINHOLE,64,48,50,50,31.5,23.5")
    with pytest.raises(ConfigError, match="SurfLSTM does not use a prior; leave prior out"):
        localizer.localize(image, prior=(np.zeros(3), np.array([1.0, 0, 0, 0])))
