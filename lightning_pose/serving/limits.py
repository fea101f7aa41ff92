"""Limits: how large, how slow and how many requests may be."""

from __future__ import annotations

import os
from dataclasses import dataclass

from lightning_pose.errors import ConfigError
from lightning_pose.localization.picture_head import MAX_PIXELS

__all__ = ["Limits"]


@dataclass(frozen=True)
class Limits:
    """What one request may take, and how many are taken at once.

    Memory is bounded by `threads + waiting` requests of at most `max_megabytes`, and `threads` decoded images of at
    most `max_pixels`.

    Attributes:
        max_megabytes: of a request's body, 10^6 bytes.
        max_pixels: of an image, before it is decoded.
        timeout_s: to receive the body, and again to answer.
        threads: images that are located at the same time.
        waiting: requests that may wait for one of the threads; further ones are refused.

    Raises:
        ConfigError: a limit is not above 0.
    """

    max_megabytes: float = 20.0
    max_pixels: int = MAX_PIXELS
    timeout_s: float = 30.0
    threads: int = os.cpu_count() or 1
    waiting: int = 64

    def __post_init__(self) -> None:
        for name in ("max_megabytes", "max_pixels", "timeout_s", "threads"):
            if not getattr(self, name) > 0:  # written so that nan is refused too
                option = name.removesuffix("_s").replace("_", "-")
                raise ConfigError(f"--{option} is {getattr(self, name)}; give more than 0")
        if self.waiting < 0:
            raise ConfigError(f"--waiting is {self.waiting}; give 0 or more")

    @property
    def max_bytes(self) -> int:
        """Of a request's body."""
        return int(self.max_megabytes * 1_000_000)
