"""Processes by machine and number: which have ended, so that their runs can be closed."""

from __future__ import annotations

import hashlib
import os
import socket
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

if TYPE_CHECKING:
    from mlflow.entities import Run

__all__ = [
    "HOST_TAG",
    "PROCESS_TAG",
    "has_died",
    "has_owner_died",
    "identify_machine",
    "is_abandoned",
    "name_owner",
    "process_name",
    "process_tags",
]

STALE_SECONDS = 3600
"""What a process of another machine has left unfinished for so long is abandoned."""

HOST_TAG, PROCESS_TAG = "process.host", "process.id"


@cache
def identify_machine() -> str:
    """Name of this machine, with a digest that distinguishes it from others of that name and from its earlier boots.

    Process numbers are unique within one boot only, or within one container.
    """
    facts = []
    with suppress(OSError):  # Linux alone has them
        facts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
    with suppress(OSError):
        facts.append(str(Path("/proc/self/ns/pid").stat().st_ino))
    digest = hashlib.sha256(" ".join(facts).encode()).hexdigest()[:8]
    return f"{socket.gethostname()} {digest}" if facts else socket.gethostname()


def process_name() -> str:
    """The name of this process, unique among all machines."""
    return f"{identify_machine()}:{os.getpid()}"


def process_tags() -> dict[str, str]:
    """Tags by which a later run finds out whether this process has ended."""
    return {HOST_TAG: identify_machine(), PROCESS_TAG: str(os.getpid())}


def has_died(process: str) -> bool:
    """Whether a process, by its `process_name`, ran on this machine and has ended; False for other machines."""
    host, _, number = process.rpartition(":")
    return host == identify_machine() and not _is_running(int(number))


def name_owner(number: int | None = None) -> str:
    """This process, or the one of a number on this machine, as a part of a file's name without points."""
    machine = hashlib.sha256(identify_machine().encode()).hexdigest()[:12]
    return f"{machine}-{os.getpid() if number is None else number}"


def is_abandoned(unfinished: Path, owner: str) -> bool:
    """Whether the process that was writing a file or folder, by its `name_owner`, was killed.

    On another machine that is taken for granted after an hour.
    """
    number = owner.rpartition("-")[2]
    if number.isdecimal() and owner == name_owner(int(number)):
        return not _is_running(int(number))
    return time.time() - unfinished.stat().st_mtime > STALE_SECONDS


def _is_running(number: int) -> bool:
    """Whether there is a process of this number; one that was killed and that its parent has not asked for is none."""
    try:
        return psutil.Process(number).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
    except psutil.AccessDenied:
        return True


def has_owner_died(run: Run) -> bool:
    """Whether the process that a run belongs to, by its tags, ran on this machine and has ended."""
    tags = run.data.tags
    if HOST_TAG not in tags or PROCESS_TAG not in tags:
        return False
    host = tags[HOST_TAG]
    if host != identify_machine() and host.partition(" ")[0] == socket.gethostname():
        return run.info.start_time / 1000 < psutil.boot_time()  # before a power failure, for example
    return has_died(f"{host}:{tags[PROCESS_TAG]}")
