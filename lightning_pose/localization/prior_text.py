"""A prior as text, as the servers take it: `x,y,z,qw,qx,qy,qz`."""

from __future__ import annotations

import numpy as np

from lightning_pose.errors import ConfigError

__all__ = ["parse_prior"]


def parse_prior(text: str | None) -> tuple[np.ndarray, np.ndarray] | None:
    """Position (3,) in the scene's unit and quaternion (4,) wxyz, camera-to-world; None of None.

    Raises:
        ConfigError: there are not seven finite numbers, or the quaternion is 0.

    >>> position, quat = parse_prior("1, 2, 3, 1, 0, 0, 0")
    >>> position.tolist(), quat.tolist()
    ([1.0, 2.0, 3.0], [1.0, 0.0, 0.0, 0.0])
    """
    if text is None:
        return None
    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape != (7,) or not np.isfinite(numbers).all() or not numbers[3:].any():
        raise ConfigError(f"prior is {text[:100]!r}; give x,y,z,qw,qx,qy,qz, camera-to-world")
    return numbers[:3], numbers[3:]
