"""TrainingMemory: for architectures whose checkpoint carries something of every training frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

from lightning import LightningModule
from torch import Tensor, nn

__all__ = ["TrainingMemory", "resize_tensors"]


class TrainingMemory(LightningModule):
    """Mixin for tensors whose length depends on the training split, such as the features of each training frame.

    Name it before `PoseModule` among the base classes. In a new module the tensors have length 0; whenever weights
    are loaded, they get the checkpoint's length. Other differences in shape are left
    for the loading to refuse.

    Attributes:
        memory: names of these parameters and buffers, as the state dict has them.
    """

    memory: ClassVar[tuple[str, ...]]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.register_load_state_dict_pre_hook(_resize_before_load)

    def resize_memory(self, state_dict: dict[str, Tensor]) -> None:
        """Give each tensor of the memory the length that it has in a state dict; its values become zeros."""
        resize_tensors(self, self.memory, state_dict)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.resize_memory(checkpoint["state_dict"])
        super().on_load_checkpoint(checkpoint)


def resize_tensors(module: nn.Module, names: Iterable[str], state_dict: Mapping[str, Tensor]) -> None:
    """Give a module's parameters and buffers the lengths that they have in a state dict; their values become zeros."""
    parameters = dict(module.named_parameters())
    for name in names:
        if name in state_dict:
            tensor = parameters[name] if name in parameters else module.get_buffer(name)
            tensor.data = tensor.new_zeros(len(state_dict[name]), *tensor.shape[1:])


def _resize_before_load(module: nn.Module, state_dict: dict[str, Tensor], prefix: str, *_: object) -> None:
    """`load_state_dict` of the module, or of one that holds it, calls this before it copies anything."""
    assert isinstance(module, TrainingMemory)
    module.resize_memory({name.removeprefix(prefix): value for name, value in state_dict.items()})
