"""Which processes have ended."""

from __future__ import annotations

import subprocess
import sys

from lightning_pose.runs.process import has_died, identify_machine


def test_a_killed_process_has_ended_before_its_parent_asks_for_it() -> None:
    """Until then the system keeps its number: a worker whose starter does not look after it would seem to run on."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        name = f"{identify_machine()}:{process.pid}"
        assert not has_died(name)
        process.kill()
        assert process.stdout is not None
        process.stdout.read()  # ends with the process, of which only its number is left
        for _ in range(1000):
            if has_died(name):
                break
        assert has_died(name)
        assert process.returncode is None
