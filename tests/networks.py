"""Tiny ONNX networks."""

from collections.abc import Sequence
from pathlib import Path

import onnx
from onnx import TensorProto, helper


def save_network(
    path: Path,
    input_shape: Sequence[int | str],
    nodes: Sequence[onnx.NodeProto] = (),
    input_type: int = TensorProto.FLOAT,
    output_type: int = TensorProto.FLOAT,
    extra_inputs: Sequence[onnx.ValueInfoProto] = (),
) -> Path:
    """Write a tiny ONNX network from "image" to "out"; by default it returns its input."""
    graph = helper.make_graph(
        list(nodes) or [helper.make_node("Identity", ["image"], ["out"])],
        "tiny",
        [helper.make_tensor_value_info("image", input_type, input_shape), *extra_inputs],
        [helper.make_tensor_value_info("out", output_type, None)],
        [helper.make_tensor("zero", TensorProto.INT64, [], [0])],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path
