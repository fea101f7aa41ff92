"""Writes `model.onnx`: a graph of torch, preceded by the preparation of the image where it reads a CNN's features."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from lightning_pose.errors import ConfigError
from lightning_pose.export.graphs import OUTPUTS, ClipGraph, make_graph
from lightning_pose.export.recurrent import list_translations
from lightning_pose.features import CNN, FeatureExtractor
from lightning_pose.models import PoseModule

if TYPE_CHECKING:
    from onnx import ModelProto

__all__ = ["OPSET", "quantize_file", "require_onnx", "write_onnx"]

OPSET = 20
"""Of ONNX's operators: the first with `Resize` as torch antialiases, and with int64 in `Where`; onnxruntime 1.17 reads it."""

EXTRA = "run `uv sync --extra export`, or `pip install onnx onnxscript onnxruntime`"

CLIP_FRAMES = 5
"""Frames of the clip that a graph is traced with; it takes any number from 2."""

PREPARE = """
<ir_version: 9, opset_import: ["" : {opset}]>
prepare (uint8[height, width, 3] image) => (float[1, 3, {side}, {side}] rgb)
<int64[2] shape_axes = {{0, 1}}, int64[1] batch = {{0}}, float[1] full = {{255.0}}, int64[2] front = {{1, 3}},
 float[1] short = {{{short}.0}}, int64[2] square = {{{side}, {side}}}, int64[1] two = {{2}}, int64[2] axes = {{2, 3}}>
{{
    channels_first = Transpose <perm = [2, 0, 1]> (image)
    one = Unsqueeze (channels_first, batch)
    as_float = Cast <to = 1> (one)
    scaled = Div (as_float, full)
    {steps}
}}
"""

RESIZE = 'Resize <mode = "linear", antialias = 1, coordinate_transformation_mode = "half_pixel">'

WHOLE = f"""
    whole = Constant <value = int64[4] {{{{1, 3, {{side}}, {{side}}}}}}> ()
    rgb = {RESIZE} (scaled, , , whole)
"""

CENTER = f"""
    shape = Shape <start = 0, end = 2> (image)
    sides = Cast <to = 11> (shape)
    shortest = ReduceMin <keepdims = 1> (sides)
    wanted = Constant <value = double[1] {{{{{{short}}.0}}}}> ()
    factor = Div (wanted, shortest)
    exact = Mul (sides, factor)
    rounded = Round (exact)
    size = Cast <to = 7> (rounded)
    target = Concat <axis = 0> (front, size)
    resized = {RESIZE} (scaled, , , target)
    spare = Sub (size, square)
    first = Div (spare, two)
    last = Add (first, square)
    rgb = Slice (resized, first, last, axes)
"""


def require_onnx() -> None:
    """Check that what writes and reads ONNX files is installed.

    Raises:
        ConfigError: it is not.
    """
    try:
        import onnx
        import onnxruntime
        import onnxscript
    except ImportError as error:
        raise ConfigError(f"export needs {error.name}, which is not installed; {EXTRA}") from error
    del onnx, onnxruntime, onnxscript


def write_onnx(model: PoseModule, extractor: FeatureExtractor, path: Path) -> None:
    """Write the network of a system, from what `runner.network` gives it to `OUTPUTS`.

    Args:
        model: of single images or of clips.
        extractor: of its features; a CNN becomes part of the graph.
        path: of the file.

    Raises:
        ConfigError: torch or ONNX cannot express the architecture; the message has the reason.
    """
    import onnx

    model = model.eval().requires_grad_(False)
    graph = make_graph(model, extractor).eval()
    example = _make_example(model, extractor)
    dynamic = ({1: torch.export.Dim("frames", min=2, max=10_000)},) if isinstance(graph, ClipGraph) else None
    proto = _trace(graph, example, list(OUTPUTS[:2] if isinstance(graph, ClipGraph) else OUTPUTS), dynamic, model)
    if isinstance(extractor, CNN):
        proto = onnx.compose.merge_models(_make_preparation(extractor), proto, [("rgb", "features")])
    proto.producer_name, proto.doc_string = "lightning_pose", ""
    onnx.save(proto, path)


def _make_example(model: PoseModule, extractor: FeatureExtractor) -> Tensor:
    """What the graph is traced with."""
    if isinstance(extractor, CNN):
        return torch.rand(1, 3, extractor.side, extractor.side)
    frames = (CLIP_FRAMES,) if model.reads_clips else ()
    values = torch.rand(1, *frames, *model.input_shape)
    return (values * 255).byte() if extractor.dtype is np.uint8 else values


def _trace(
    graph: nn.Module, example: Tensor, outputs: list[str], dynamic: tuple[object, ...] | None, model: PoseModule
) -> ModelProto:
    """The graph in ONNX; its one input is named `features`."""
    try:
        with torch.no_grad(), _silence():
            program = torch.onnx.export(
                graph,
                (example,),
                input_names=["features"],
                output_names=outputs,
                opset_version=OPSET,
                dynamo=True,
                dynamic_shapes=dynamic,
                custom_translation_table=list_translations(),
                verbose=False,
            )
    except Exception as error:  # torch, its tracer and onnxscript raise many kinds
        reason = " ".join(str(error.__cause__ or error).split())[:300]
        raise ConfigError(f"{type(model).__name__} with these settings cannot be written as ONNX: {reason}") from error
    assert program is not None
    return program.model_proto


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Hide what torch's exporter says on its way."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir", "torch.export")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _make_preparation(extractor: CNN) -> ModelProto:
    """What `CNN.extract` does to an image of any size before its network sees it."""
    import onnx

    steps = (WHOLE if extractor.crop == "whole" else CENTER).format(side=extractor.side, short=extractor.short_side)
    text = PREPARE.format(opset=OPSET, side=extractor.side, short=extractor.short_side, steps=steps)
    return onnx.parser.parse_model(text)


def quantize_file(path: Path, out: Path) -> None:
    """Write a graph with its weights in 8 bits, and products in 8 bits where onnxruntime has them."""
    from onnxruntime.quantization import QuantType, quantize_dynamic

    with _silence():
        quantize_dynamic(path, out, weight_type=QuantType.QInt8, per_channel=True)
