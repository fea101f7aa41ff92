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

__all__ = ["OPSET", "require_onnx", "silence_exporter", "write_onnx"]

OPSET = 20
"""Version of ONNX's operators; onnxruntime reads it from 1.17 on."""

EXTRA = "run `uv sync --extra export`, or `pip install onnx onnxscript onnxruntime`"

CLIP_FRAMES = 5
"""Frames of the clip that a graph is traced with; it takes any number from 2."""

PREPARE = """
<ir_version: {version}, opset_import: ["" : {opset}]>
prepare (uint8[height, width, 3] image) => (float[1, 3, {side}, {side}] rgb)
<float full = {{255.0}}, float zero = {{0.0}}, float one = {{1.0}}, float half = {{0.5}}, int64[1] batch = {{0}},
 int64[1] last = {{1}}, int64 two = {{2}}, int64 side = {{{side}}}, double short = {{{short}.0}}>
{{
    channels_first = Transpose <perm = [2, 0, 1]> (image)
    as_float = Cast <to = 1> (channels_first)
    pixels = Div (as_float, full)
    sides = Shape <end = 2> (image)
    shortest = ReduceMin <keepdims = 0> (sides)
    {rows}
    {columns}
    narrow = MatMul (pixels, columns_across)
    small = MatMul (rows_weights, narrow)
    rgb = Unsqueeze (small, batch)
}}
"""
"""An image of any size to the square that a CNN reads."""

AXIS = """
    {axis}_number = Constant <value = int64 {{{number}}}> ()
    {axis}_length = Gather (sides, {axis}_number)
    {size}
    {axis}_spare = Sub ({axis}_size, side)
    {axis}_first = Div ({axis}_spare, two)
    {axis}_end = Add ({axis}_first, side)
    {axis}_step = Constant <value = int64 {{1}}> ()
    {axis}_start = Constant <value = int64 {{0}}> ()
    {axis}_length_f = Cast <to = 1> ({axis}_length)
    {axis}_size_f = Cast <to = 1> ({axis}_size)
    {axis}_scale = Div ({axis}_length_f, {axis}_size_f)
    {axis}_wide = Max ({axis}_scale, one)
    {axis}_to = Range ({axis}_first, {axis}_end, {axis}_step)
    {axis}_to_f = Cast <to = 1> ({axis}_to)
    {axis}_to_middle = Add ({axis}_to_f, half)
    {axis}_centre = Mul ({axis}_to_middle, {axis}_scale)
    {axis}_column = Unsqueeze ({axis}_centre, last)
    {axis}_from = Range ({axis}_start, {axis}_length, {axis}_step)
    {axis}_from_f = Cast <to = 1> ({axis}_from)
    {axis}_from_middle = Add ({axis}_from_f, half)
    {axis}_apart = Sub ({axis}_from_middle, {axis}_column)
    {axis}_away = Abs ({axis}_apart)
    {axis}_share = Div ({axis}_away, {axis}_wide)
    {axis}_height = Sub (one, {axis}_share)
    {axis}_raw = Max ({axis}_height, zero)
    {axis}_sum = ReduceSum <keepdims = 1> ({axis}_raw, last)
    {axis}_weights = Div ({axis}_raw, {axis}_sum)
    {axis}_across = Transpose <perm = [1, 0]> ({axis}_weights)
"""
"""Weights (side, length) of bilinear interpolation with antialiasing along one axis: a triangle around each centre.

ONNX has `Resize` with antialiasing, but onnxruntime 1.32 computes it wrongly where the two axes shrink differently.
"""

WHOLE = "{axis}_size = Identity (side)"
CENTER = """{axis}_exact = Cast <to = 11> ({axis}_length)
    {axis}_shortest = Cast <to = 11> (shortest)
    {axis}_factor = Div (short, {axis}_shortest)
    {axis}_product = Mul ({axis}_exact, {axis}_factor)
    {axis}_rounded = Round ({axis}_product)
    {axis}_size = Cast <to = 7> ({axis}_rounded)"""
"""Length of an axis once the whole image is resized: to the square itself, or until its shorter side is `short`."""


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
        proto = onnx.compose.merge_models(_make_preparation(extractor, proto.ir_version), proto, [("rgb", "features")])
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
        with torch.no_grad(), silence_exporter():
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
def silence_exporter() -> Iterator[None]:
    """Hide what torch's exporter and ONNX's optimizer say on their way."""
    loggers = [logging.getLogger(name) for name in (None, "torch.onnx", "onnxscript", "onnx_ir", "torch.export")]
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


def _make_preparation(extractor: CNN, version: int) -> ModelProto:
    """What `CNN.extract` does to an image of any size before its network sees it."""
    import onnx

    size = WHOLE if extractor.crop == "whole" else CENTER
    rows, columns = (
        AXIS.format(axis=axis, number=number, size=size.format(axis=axis))
        for number, axis in enumerate(("rows", "columns"))
    )
    text = PREPARE.format(
        version=version, opset=OPSET, side=extractor.side, short=extractor.short_side, rows=rows, columns=columns
    )
    return onnx.parser.parse_model(text)
