"""WorldFrame: the origin and the scale by which networks see a scene's positions as small numbers."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["WorldFrame"]

SMALLEST_SPREAD, LARGEST_SPREAD = 0.03, 200.0
"""Spreads of positions (root mean square distance from their mean) that are taken for metres.

A hand-held camera that only turns has 0.07 m, a street 100 m.
"""

THOUSAND = 1000.0
"""Scales are powers of it, so that a scene in millimetres or kilometres looks to a network as it does in metres."""

FAR = 30.0
"""A scene this many times its spread from the origin, or up to ten times as many, gets an origin of its own."""

NEAR = 10.0
"""In a scene with an origin of its own, the mean is at most this many times the spread away from it."""


class WorldFrame(nn.Module):
    """Maps positions of the world, float64, to those that a network sees, and back: world = origin + scale * local.

    Single precision has seven digits: at 5,000 km, as UTM coordinates have them, its steps are 0.5 m. So positions
    are float64 in the world, and networks and losses see small numbers. Most scenes are near their origin and in
    metres: there the origin is 0 and the scale 1, and local positions are those of the world. The same scene moved
    far away, or in millimetres or kilometres, has the same local positions.

    Both numbers are in the state dict, as four float64 numbers on the CPU that no precision setting rounds. A state
    dict without them, of a checkpoint written before they existed, stands for origin 0 and scale 1.

    Args:
        centred: whether positions have an origin; relative positions, of clips, have none.
    """

    def __init__(self, centred: bool = True) -> None:
        super().__init__()
        self.centred = centred
        self.origin = torch.zeros(3, dtype=torch.float64)
        self.scale = 1.0
        self.register_load_state_dict_pre_hook(_add_missing_state)

    def fit(self, position_m: Tensor) -> None:
        """Choose origin and scale for (M, 3) training positions of the world, float64, in the scene's unit."""
        position = position_m.double().cpu()
        mean = position.mean(0)
        spread = float((position - mean).square().sum(1).mean().sqrt())
        self.scale = _choose_scale(spread)
        if self.centred:
            self.origin = _choose_origin(mean / self.scale, spread / self.scale) * self.scale

    def to_local(self, position_m: Tensor) -> Tensor:
        """Positions (..., 3) of the world as the network sees them, float64."""
        return (position_m.double() - self.origin.to(position_m.device)) / self.scale

    def to_world(self, position: Tensor) -> Tensor:
        """The network's positions (..., 3) in the world, float64; on the CPU where the device has no float64."""
        if position.device.type == "mps":
            position = position.cpu()
        return position.double() * self.scale + self.origin.to(position.device)

    def get_extra_state(self) -> Tensor:
        """Origin and scale, (4,) float64, for the state dict."""
        return torch.cat([self.origin, self.origin.new_tensor([self.scale])])

    def set_extra_state(self, state: Tensor) -> None:
        """Take origin and scale from a state dict."""
        state = state.detach().double().cpu()
        self.origin, self.scale = state[:3].clone(), float(state[3])


def _choose_scale(spread: float) -> float:
    """1 for a spread that may be one of metres; otherwise the power of 1000 that brings it to 0.03 to 30."""
    if not 0 < spread < math.inf or SMALLEST_SPREAD <= spread < LARGEST_SPREAD:
        return 1.0
    return THOUSAND ** math.floor(math.log(spread / SMALLEST_SPREAD, THOUSAND))


def _choose_origin(mean: Tensor, spread: float) -> Tensor:
    """A round origin (3,) near the mean; 0 where that is near already, so that round shifts leave no trace."""
    if not 0 < spread < math.inf:
        spread = 1.0
    origin = _round_to(mean, 10 ** math.ceil(math.log10(FAR * spread)))
    if not origin.any():
        return origin
    rest = mean - origin
    finer = _round_to(rest, 10 ** math.ceil(math.log10(spread)))
    return origin + torch.where(rest.abs() > NEAR * spread, finer, torch.zeros_like(rest))


def _round_to(values: Tensor, step: float) -> Tensor:
    """The multiples of a step that are nearest to the values."""
    return (values / step).round() * step


def _add_missing_state(module: nn.Module, state_dict: dict[str, Any], prefix: str, *_: object) -> None:
    """Give a state dict of an older checkpoint origin 0 and scale 1."""
    state_dict.setdefault(f"{prefix}_extra_state", torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64))
