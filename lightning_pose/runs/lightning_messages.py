"""Messages of Lightning: which of them users see, and which of its errors are refusals of a setting."""

from __future__ import annotations

import logging
import re
import traceback
import warnings
from pathlib import Path

import lightning
from lightning.fabric.utilities.exceptions import MisconfigurationException

__all__ = ["describe_refusal", "filter_messages"]

LIGHTNING = Path(lightning.__file__).parent

NO_ACTION = re.compile(
    r"\W*(Tip:|(GPU|TPU|HPU) available|Restoring states|Restored all states|Loaded model weights|Seed set to"
    r"|`Trainer.fit` stopped: `max_epochs|`Trainer\(.*was configured so|Trainer already configured with model summary"
    r"|Initializing distributed|-{20}|distributed_backend=|All distributed processes|LOCAL_RANK"
    r"|Using (16bit|bfloat16) Automatic|Loading `train_dataloader`|Running in `fast_dev_run`"
    r"|Detected KeyboardInterrupt|.*(Received|Bypassing) SIGTERM)"
)
"""How messages begin that no user can act on, or that repeat what the user asked for."""


class _ActionFilter(logging.Filter):
    """Drops messages of Lightning that no user can act on; a notice that a setting is ignored goes through."""

    def filter(self, record: logging.LogRecord) -> bool:
        return record.levelno > logging.INFO or not NO_ACTION.match(record.getMessage())


_filter = _ActionFilter()


def filter_messages() -> None:
    """Show messages of Lightning on settings; drop the others, and warnings of libraries that no user can act on."""
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        for handler in logging.getLogger(name).handlers:
            handler.addFilter(_filter)  # of handlers, because a logger's own filters do not see its children's records
    warnings.filterwarnings("ignore", message=".*LeafSpec.*")  # Lightning's own use of torch
    warnings.filterwarnings("ignore", message=".*torch.jit.script.* is deprecated")  # PyG's
    warnings.filterwarnings("ignore", message=".*dirpath has changed|Checkpoint directory .* exists")  # resumed runs
    warnings.filterwarnings("ignore", message=r".*Please add the following callbacks: \['Timer'\]")  # older checkpoints
    # Repeated frames are left out of all metrics.
    warnings.filterwarnings("ignore", message="Using `DistributedSampler` with the dataloaders")


def describe_refusal(error: Exception) -> str | None:
    """Lightning's words in one line where it refuses a setting; None for an error that is no refusal.

    A refusal is an exception of one of these kinds that Lightning's own code raises. An error that comes out of
    torch, of this package or of a user's module keeps its traceback.
    """
    if not isinstance(error, MisconfigurationException | ValueError | TypeError | RuntimeError | ModuleNotFoundError):
        return None
    frames = list(traceback.walk_tb(error.__traceback__))
    raised_by = Path(frames[-1][0].f_code.co_filename) if frames else Path()
    if not isinstance(error, MisconfigurationException) and not raised_by.is_relative_to(LIGHTNING):
        return None
    says = " ".join(str(error).split())
    return says.rstrip(". ")
