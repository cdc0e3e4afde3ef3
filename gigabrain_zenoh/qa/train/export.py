"""Writes a trained net as ONNX, with the normalisation folded into its weights."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from gigabrain_zenoh.qa.train import net
from gigabrain_zenoh.vision.recognizer import HEIGHT_PX, STRIDE_PX, WIDTH_PX

OPSET, IR_VERSION = 13, 8


class OnnxOps:
    """The net's operations as nodes of an ONNX graph; a tensor is its name."""

    def __init__(self, folded: Mapping[str, tuple[Any, Any]]) -> None:
        self._folded = folded
        self.nodes: list[onnx.NodeProto] = []
        self.numbers: list[onnx.TensorProto] = [
            numpy_helper.from_array(np.array([1, 1, 2, 2], np.float32), "twice")
        ]

    def _node(self, kind: str, inputs: list[str], **more: Any) -> str:
        name = f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], **more))
        return name

    def conv(
        self,
        x: str,
        name: str,
        channels: int,
        *,
        size: int = 3,
        stride: int = 1,
        dilation: int = 1,
        normed: bool = True,
    ) -> str:
        """Convolve with the folded weights."""
        w, b = self._folded[name]
        self.numbers += [
            numpy_helper.from_array(
                np.ascontiguousarray(w.transpose(3, 2, 0, 1), np.float32), f"{name}.w"
            ),
            numpy_helper.from_array(np.ascontiguousarray(b, np.float32), f"{name}.b"),
        ]
        pad = dilation * (size // 2)
        return self._node(
            "Conv",
            [x, f"{name}.w", f"{name}.b"],
            kernel_shape=[size, size],
            pads=[pad] * 4,
            strides=[stride, stride],
            dilations=[dilation, dilation],
        )

    def relu(self, x: str) -> str:
        """Apply ReLU."""
        return self._node("Relu", [x])

    def add(self, a: str, b: str) -> str:
        """Add two tensors."""
        return self._node("Add", [a, b])

    def double(self, x: str) -> str:
        """Repeat each cell twice in both directions."""
        modes = {
            "mode": "nearest",
            "nearest_mode": "floor",
            "coordinate_transformation_mode": "asymmetric",
        }
        return self._node("Resize", [x, "", "twice"], **modes)


def model(params: net.Params, moments: net.Params) -> onnx.ModelProto:
    """Return the net for one picture of fixed shape (1, 3, 240, 320), from 0 to 1."""
    ops = OnnxOps(net.fold(params, moments))
    last = net.network(ops, "picture")
    shape = [1, net.OUTPUTS, HEIGHT_PX // STRIDE_PX, WIDTH_PX // STRIDE_PX]
    ops.nodes[-1].output[0] = "cells"
    assert last == f"t{len(ops.nodes) - 1}", "the last node answers"
    graph = helper.make_graph(
        ops.nodes,
        "things",
        [helper.make_tensor_value_info("picture", TensorProto.FLOAT, [1, 3, HEIGHT_PX, WIDTH_PX])],
        [helper.make_tensor_value_info("cells", TensorProto.FLOAT, shape)],
        ops.numbers,
    )
    exported = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])
    exported.ir_version = IR_VERSION
    onnx.checker.check_model(exported, full_check=True)
    return exported


def export(params: net.Params, moments: net.Params, path: Path) -> None:
    """Write the net to a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(model(params, moments).SerializeToString())
