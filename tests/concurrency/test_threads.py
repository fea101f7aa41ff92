"""Tests of how many threads small work takes, and of threads that wait."""

from __future__ import annotations

import importlib
import os

import pytest
import torch

import lightning_pose
from lightning_pose.concurrency.threads import use_one_thread


def test_small_work_takes_one_thread_and_others_have_theirs_again() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with use_one_thread() as threads:
            inside = threads, torch.get_num_threads()
        assert inside == (2, 1)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("given", "spins"),
    [({}, "1000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "ACTIVE"}, None)],
)
def test_threads_that_wait_soon_sleep(
    given: dict[str, str], spins: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    importlib.reload(lightning_pose)
    assert os.environ.get("GOMP_SPINCOUNT") == spins
