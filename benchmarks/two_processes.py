"""Every architecture trained by one process and by several, on small made problems: the difference of what they learn.

    python -m benchmarks.two_processes
    torchrun --nproc_per_node 2 -m benchmarks.two_processes

The first command keeps weights and losses in build/two_processes.pt; the second compares its own with them. Closed
forms and maps should differ by 1e-6 at most. Networks step on other batches, of as many frames together, so that they
end elsewhere: the training loss of their last epoch says how close they come.
"""

from __future__ import annotations

import argparse
import logging
import os
import warnings
from pathlib import Path

import torch
from lightning import Trainer
from torch import Tensor

from lightning_pose import models
from lightning_pose.data.batches import make_loader
from tests.models.helpers import ARCHITECTURES, make_model, problem_for

FILE = Path("build/two_processes.pt")
SOLVED = (models.LinearPoseNet, models.KernelPoseNet, models.LandmarkMap)
"""Without steps, so that the number of processes should change nothing."""


def train(architecture: type[models.PoseModule], epochs: int) -> tuple[dict[str, Tensor], float, int, bool]:
    """Weights, the last epoch's loss, the number of processes, and whether this is the first of them."""
    model = make_model(architecture)
    trainer = Trainer(
        max_epochs=1 if architecture in SOLVED else epochs,
        accelerator="cpu",
        devices=int(os.environ.get("LOCAL_WORLD_SIZE", "1")),  # which torchrun sets
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    torch.manual_seed(trainer.global_rank)  # processes drop out other units
    problem = problem_for(model)
    frames = problem.train_dataloader().dataset
    problem.train_dataloader = lambda: make_loader(frames, 8 // trainer.world_size, shuffle=True)
    trainer.fit(model, datamodule=problem)
    loss = float(trainer.callback_metrics["train/loss"])
    weights = {name: tensor.detach().clone() for name, tensor in model.state_dict().items()}
    if trainer.world_size > 1:
        for name, tensor in weights.items():
            gathered = trainer.strategy.all_gather(tensor.double()) if tensor.numel() else tensor[None]
            if trainer.is_global_zero and not all(torch.equal(gathered[0], other) for other in gathered):
                print(f"{architecture.__name__}: {name} differs between the processes")
    return weights, loss, trainer.world_size, trainer.is_global_zero


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=15)
    args = parser.parse_args()
    warnings.filterwarnings("ignore")
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    torch.set_num_threads(1)
    found = {}
    for architecture in ARCHITECTURES:
        weights, loss, processes, first = train(architecture, args.epochs)
        found[architecture.__name__] = weights, loss
        if not first or processes == 1:
            continue
        alone, alone_loss = torch.load(FILE)[architecture.__name__]
        line = f"{architecture.__name__:14s} loss {alone_loss:.4f} with one process, {loss:.4f} with {processes}"
        if architecture in SOLVED:
            gaps = [
                (weights[name].double() - alone[name].double()).abs().max() for name in alone if alone[name].numel()
            ]
            line += f"; weights differ by at most {float(max(gaps)):.1e}"
        print(line, flush=True)
    if processes == 1:
        FILE.parent.mkdir(exist_ok=True)
        torch.save(found, FILE)
        print(f"{len(found)} architectures in {FILE}")


if __name__ == "__main__":
    main()
