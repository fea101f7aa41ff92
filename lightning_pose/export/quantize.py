"""Writes an ONNX graph with its weights in 8 bits; onnxruntime multiplies them out when it loads the file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lightning_pose.export.onnx_files import silence_exporter

if TYPE_CHECKING:
    from onnx import ModelProto

__all__ = ["quantize_file"]

LARGEST = 2**28
"""Numbers in an array that is computed once and for all before weights are shrunk."""

SMALLEST = 1024
"""Arrays of fewer numbers stay as they are."""

WEIGHTS = {"Conv": (1,), "Gemm": (1,), "MatMul": (0, 1), "LSTM": (1, 2), "GRU": (1, 2)}
"""Operators, and which of their inputs are weights."""

STEPS = 127


def quantize_file(path: Path, out: Path) -> None:
    """Write a graph whose weights are whole numbers from -127 to 127 with a scale for each filter, column or row.

    What the graph computes is in 32 bits as before: activations in 8 bits cost networks of images their accuracy.
    """
    import onnx
    from onnxscript import optimizer

    with silence_exporter():  # weights that the graph computes of others could not be shrunk
        model = optimizer.optimize(onnx.load(path), input_size_limit=LARGEST, output_size_limit=LARGEST)
    for name, axes in find_weights(model).items():
        shrink_weight(model, name, axes)
    onnx.save(model, out)


def find_weights(model: ModelProto) -> dict[str, tuple[int, ...]]:
    """Names of constant weights, and the axes over which the numbers of a scale lie."""
    constants = {constant.name: len(constant.dims) for constant in model.graph.initializer if is_large(constant)}
    found: dict[str, tuple[int, ...]] = {}
    for node in model.graph.node:
        for place in WEIGHTS.get(node.op_type, ()):
            name = node.input[place]
            if name in constants:
                turned = any(attribute.name == "transB" and attribute.i for attribute in node.attribute)
                by_column = (node.op_type == "MatMul" and place == 1) or (node.op_type == "Gemm" and not turned)
                inner = range(1, constants[name]) if node.op_type == "Conv" else (-2,) if by_column else (-1,)
                found.setdefault(name, tuple(inner))
    return found


def is_large(constant: object) -> bool:
    """Whether an initializer is a float32 matrix, or more, that is worth shrinking."""
    from onnx import TensorProto

    assert isinstance(constant, TensorProto)
    many = len(constant.dims) >= 2 and np.prod(constant.dims) >= SMALLEST
    return bool(many and constant.data_type == TensorProto.FLOAT)


def shrink_weight(model: ModelProto, name: str, axes: tuple[int, ...]) -> None:
    """Replace a constant by whole numbers, and by the two operators that multiply them out."""
    from onnx import TensorProto, helper, numpy_helper

    graph = model.graph
    (constant,) = (each for each in graph.initializer if each.name == name)
    values = numpy_helper.to_array(constant)
    largest = np.abs(values).max(axis=axes, keepdims=True)
    scale = np.where(largest > 0, largest / STEPS, 1).astype(np.float32)
    graph.initializer.remove(constant)
    whole, real, factor = (f"{name}_{part}" for part in ("int8", "whole", "scale"))
    graph.initializer.append(numpy_helper.from_array(np.round(values / scale).astype(np.int8), whole))
    graph.initializer.append(numpy_helper.from_array(scale, factor))
    graph.node.insert(0, helper.make_node("Mul", [real, factor], [name]))
    graph.node.insert(0, helper.make_node("Cast", [whole], [real], to=TensorProto.FLOAT))
