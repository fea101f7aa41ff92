"""Responses of the first layers of a model of clips."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lightning_pose.models.base import PoseModule

__all__ = ["record_responses"]


@torch.no_grad()
def record_responses(model: PoseModule, clip: Tensor, layers: int = 2) -> dict[str, Tensor]:
    """Outputs of a network's first convolutions and activations for one clip (thesis, fig. 6.5).

    Args:
        model: of clips, in any mode.
        clip: (T, *input_shape).
        layers: how many convolutions.

    Returns:
        `convolution 1`, `activation 1`, ...: (T, channels, height, width) each.
    """
    found: dict[str, Tensor] = {}
    handles = []
    for kind, name in (((nn.Conv2d, nn.Conv3d), "convolution"), ((nn.ReLU,), "activation")):
        chosen = [module for module in model.network.modules() if isinstance(module, kind)][:layers]
        for number, module in enumerate(chosen, 1):

            def keep(_: nn.Module, __: object, out: Tensor, name: str = f"{name} {number}") -> None:
                # Conv3d returns (1, C, T, H, W), Conv2d over frames (T, C, H, W).
                found[name] = (out[0].transpose(0, 1) if out.ndim == 5 else out).clone().cpu()

            handles.append(module.register_forward_hook(keep))
    training = model.training
    try:
        model.eval()(clip[None].to(model.device))
    finally:
        model.train(training)
        for handle in handles:
            handle.remove()
    order = [f"{name} {number}" for number in range(1, layers + 1) for name in ("convolution", "activation")]
    return {name: found[name] for name in order if name in found}
