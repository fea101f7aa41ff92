"""Processes by machine and number: which are gone, so that their runs can be closed."""

from __future__ import annotations

import hashlib
import os
import socket
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlflow.entities import Run

__all__ = ["HOST_TAG", "PROCESS_TAG", "has_died", "machine", "process_name", "process_tags"]

HOST_TAG, PROCESS_TAG = "process.host", "process.id"


@cache
def machine() -> str:
    """Name of this machine, with a digest that distinguishes it from others of that name and from its earlier boots.

    Process numbers mean something within one boot only, and within one container where it counts its own.
    """
    facts = []
    with suppress(OSError):  # Linux alone has them
        facts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
    with suppress(OSError):
        facts.append(str(Path("/proc/self/ns/pid").stat().st_ino))
    digest = hashlib.sha256(" ".join(facts).encode()).hexdigest()[:8]
    return f"{socket.gethostname()} {digest}" if facts else socket.gethostname()


def process_name() -> str:
    """This process, on whatever machine."""
    return f"{machine()}:{os.getpid()}"


def process_tags() -> dict[str, str]:
    """Tags from which a later run finds out that this process has ended."""
    return {HOST_TAG: machine(), PROCESS_TAG: str(os.getpid())}


def has_died(process: str) -> bool:
    """Whether a process, by its `process_name`, was of this machine and is gone; of other machines nothing is known."""
    host, _, number = process.rpartition(":")
    if host != machine():
        return False
    try:
        os.kill(int(number), 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        pass
    return False


def has_owner_died(run: Run) -> bool:
    tags = run.data.tags
    if HOST_TAG not in tags or PROCESS_TAG not in tags:
        return False
    host = tags[HOST_TAG]
    if host != machine() and host.partition(" ")[0] == socket.gethostname():
        return run.info.start_time / 1000 < _booted()  # before a power failure, say
    return has_died(f"{host}:{tags[PROCESS_TAG]}")


def _booted() -> float:
    """When this machine started, in seconds since 1970; 0 where that is not known."""
    if not hasattr(time, "CLOCK_BOOTTIME"):
        return 0.0
    return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME)
