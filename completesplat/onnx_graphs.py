"""Networks as ONNX graphs, with a description of how a program without torch runs them."""

import logging
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from completesplat.errors import CompleteSplatError
from completesplat.files import make_folder, write_bytes, write_json
from completesplat.installation import install_command

Precision = Literal["float32", "float16"]
OPSET = 18
TALKATIVE = ("torch.onnx", "onnxscript", "onnx_ir")
"""Libraries that log what they simplify, and what packages they miss that no graph here needs."""
PIPELINE_FILE = "pipeline.json"
MOST_SAMPLES = 63
"""Samples that a graph takes at a time; diffusers' upsampling works otherwise with more."""
SMALLEST_HALVED = 64
"""Values of a tensor from which on it is stored in float16."""


@dataclass(frozen=True)
class Graph:
    """Part of a model that is written as one ONNX graph.

    Attributes:
        name: name of its file, without `.onnx`.
        owner: module whose weights it uses.
        function: it takes and returns tensors by their names.
        inputs: examples. Those of `per_sample` have two samples.
        per_sample: names of the inputs whose first axis counts samples; in the graph it has any length up to
            `MOST_SAMPLES`.
    """

    name: str
    owner: nn.Module
    function: Callable[[Mapping[str, Tensor]], Mapping[str, Tensor]]
    inputs: Mapping[str, Tensor]
    per_sample: Sequence[str] = ()


class _Call(nn.Module):
    """Module that calls a graph's function, for the exporter."""

    def __init__(self, graph: Graph) -> None:
        super().__init__()
        self.owner = graph.owner
        self.function = graph.function

    def forward(self, inputs: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
        return self.function(inputs)


def write_graphs(
    folder: Path | str, graphs: Sequence[Graph], description: Mapping[str, Any], precision: Precision
) -> None:
    """Write graphs and `pipeline.json`, which describes them, into a folder.

    Args:
        precision: how weights are stored. The graphs compute in float32.

    Raises:
        CompleteSplatError: the packages of the extra `onnx` are missing, or torch cannot export a part.
        DiskError: the folder cannot be written.
    """
    folder = Path(folder)
    contents = {}
    described = {}
    for graph in graphs:
        model = _exported(graph)
        if precision == "float16":
            _halve_stored(model)
        file = f"{graph.name}.onnx"
        contents[file] = model.SerializeToString()
        described[graph.name] = {
            "file": file,
            "inputs": [value.name for value in model.graph.input],
            "outputs": [value.name for value in model.graph.output],
        }
    folder.parent.mkdir(parents=True, exist_ok=True)
    make_folder(folder)
    for file, content in contents.items():
        write_bytes(folder / file, content)
    write_json(folder / PIPELINE_FILE, {**description, "precision": precision, "graphs": described})


def _exported(graph: Graph) -> Any:
    """Return a graph as an `onnx.ModelProto`."""
    try:
        import onnxscript  # noqa: F401  the exporter needs it
    except ImportError as error:
        raise CompleteSplatError(f"ONNX files need further packages: {install_command('onnx')}") from error
    for name in TALKATIVE:
        logging.getLogger(name).setLevel(logging.ERROR)
    samples = torch.export.Dim("samples", max=MOST_SAMPLES)
    shapes = {name: {0: samples} if name in graph.per_sample else None for name in graph.inputs}
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's exporter about itself
        outputs = graph.function(graph.inputs)
        try:
            program = torch.onnx.export(
                _Call(graph).eval(),
                kwargs={"inputs": dict(graph.inputs)},
                input_names=list(graph.inputs),
                output_names=list(outputs),
                dynamic_shapes={"inputs": shapes},
                opset_version=OPSET,
                dynamo=True,
                external_data=False,
                verbose=False,
            )
        except torch.onnx.OnnxExporterError as error:
            reason = str(error.__cause__ or error).strip().splitlines()[0]
            raise CompleteSplatError(f"{graph.name}: torch cannot export it to ONNX: {reason}") from error
    assert program is not None
    for value in program.model_proto.graph.input:
        if value.name in graph.per_sample and not value.type.tensor_type.shape.dim[0].dim_param:
            reason = "its code takes the number of samples for a constant (`len(x)` in place of `x.shape[0]`?)"
            raise CompleteSplatError(f"{graph.name}: {reason}")
    return program.model_proto


def _halve_stored(model: Any) -> None:
    """Store a graph's float32 weights in float16, and convert them back where the graph starts.

    Raises:
        CompleteSplatError: a weight is too large for float16.
    """
    from onnx import TensorProto, helper, numpy_helper

    casts = []
    for tensor in model.graph.initializer:
        if tensor.data_type != TensorProto.FLOAT or math.prod(tensor.dims) < SMALLEST_HALVED:
            continue
        values = numpy_helper.to_array(tensor)
        if np.abs(values).max() > np.finfo(np.float16).max:
            raise CompleteSplatError(f"{tensor.name}: too large for float16; precision=float32 stores it")
        stored = f"{tensor.name}.float16"
        casts.append(helper.make_node("Cast", [stored], [tensor.name], to=TensorProto.FLOAT))
        tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), stored))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
