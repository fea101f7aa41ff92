"""State of the random numbers that training draws, so that a resumed run goes on as if it had not stopped."""

from __future__ import annotations

import random
from typing import TypedDict

import numpy as np
import torch
from torch import distributed

__all__ = ["RandomState", "collect_random_states", "restore_random_state"]


class RandomState(TypedDict):
    """Plain types and tensors, which checkpoints may hold; `cuda` has the state of each device."""

    python: tuple[object, ...]
    numpy: tuple[str, list[int], int, int, float]
    torch: torch.Tensor
    cuda: list[torch.Tensor]


def _read_random_state() -> RandomState:
    """The state of this process."""
    name, keys, place, has_gauss, gauss = np.random.get_state()  # noqa: NPY002  (the one that libraries draw from)
    return {
        "python": random.getstate(),
        "numpy": (str(name), np.asarray(keys).tolist(), int(place), int(has_gauss), float(gauss)),
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
    }


def collect_random_states() -> list[RandomState]:
    """The state of each process; all of them call it."""
    own = _read_random_state()
    states = [own]
    if distributed.is_available() and distributed.is_initialized():
        states = [own] * distributed.get_world_size()
        distributed.all_gather_object(states, own)
    return states


def restore_random_state(states: list[RandomState]) -> None:
    """Set this process's state to its own of `collect_random_states`; nothing where there were fewer processes."""
    rank = distributed.get_rank() if distributed.is_available() and distributed.is_initialized() else 0
    if rank >= len(states):
        return
    state = states[rank]
    random.setstate(state["python"])
    name, keys, place, has_gauss, gauss = state["numpy"]
    np.random.set_state((name, np.array(keys, np.uint32), place, has_gauss, gauss))  # noqa: NPY002
    torch.set_rng_state(state["torch"].cpu())
    if len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all([part.cpu() for part in state["cuda"]])
