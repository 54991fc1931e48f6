"""Writes the ONNX graph of the image encoder: `python -m tools.image_encoder_graph PATH_OF_THE_PTH_FILE`.

The graph is EfficientNet-Lite0 (Tan & Le 2019) without its classifier, from pixels to pooled features. It contains no
weights: each tensor refers to its place in the pinned .pth file, as external data of that file. The graph is part of
the package, and this module is needed only to write it again: `pip install onnx torch`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import onnx
import torch
from onnx import helper

from dualbrain.memory.embedding.image_encoder import GRAPH, INPUT_SIZE, WEIGHTS_FILE

BATCH_NORM_EPSILON = 1e-3
STEM_CHANNELS = 32
STAGES = ((1, 1, 1, 16), (2, 2, 6, 24), (2, 2, 6, 40), (3, 2, 6, 80), (3, 1, 6, 112), (4, 2, 6, 192), (1, 1, 6, 320))
"""(repeats, stride, expansion, channels) of each stage; a stem and a head enclose the stages."""
RELU6_BOUNDS = {"zero": 0.0, "six": 6.0}


class GraphBuilder:
    """Nodes and tensors of a graph; torch read the tensors `state` from the file with the content `data`."""

    def __init__(self, data: bytes, state: dict[str, torch.Tensor]) -> None:
        self.data, self.state = data, state
        self.nodes: list[onnx.NodeProto] = []
        self.tensors = [
            helper.make_tensor(name, onnx.TensorProto.FLOAT, [], [value]) for name, value in RELU6_BOUNDS.items()
        ]

    def add(self, operator: str, *inputs: str, **attributes: object) -> str:
        """Append a node and return the name of its output."""
        output = f"{operator}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [output], **attributes))
        return output

    def convolution(self, x: str, name: str, norm: str, stride: int = 1, *, activation: bool = True) -> str:
        """Convolution `name` without a bias, batch normalisation `norm` and, with `activation`, ReLU6 of `x`."""
        n_out, n_in, height, width = self.state[f"{name}.weight"].shape
        stored = self.tensor(f"{name}.weight", (height, width, n_in, n_out))
        weight = self.add("Transpose", stored, perm=[3, 2, 0, 1])
        groups = n_out if n_in == 1 else 1
        x = self.add("Conv", x, weight, auto_pad="SAME_UPPER", strides=[stride, stride], group=groups)
        statistics = [self.tensor(f"{norm}.{part}") for part in ("weight", "bias", "running_mean", "running_var")]
        x = self.add("BatchNormalization", x, *statistics, epsilon=BATCH_NORM_EPSILON)
        return self.add("Clip", x, *RELU6_BOUNDS) if activation else x

    def tensor(self, name: str, shape: tuple[int, ...] | None = None) -> str:
        """Add a reference to the tensor `name`, whose axes in the file are those of `shape`; returns `name`."""
        content = bytes(self.state[name].untyped_storage())
        place = {"location": WEIGHTS_FILE, "offset": self.data.index(content), "length": len(content)}
        tensor = onnx.TensorProto(name=name, data_type=onnx.TensorProto.FLOAT, dims=shape or self.state[name].shape)
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.extend(onnx.StringStringEntryProto(key=key, value=str(place[key])) for key in place)
        self.tensors.append(tensor)
        return name


def build(weights: Path) -> onnx.ModelProto:
    """The model from pixels (1, 3, 224, 224), scaled to about ±1, to pooled features (1, 1280, 1, 1)."""
    graph = GraphBuilder(weights.read_bytes(), torch.load(weights, map_location="cpu", weights_only=True))
    x, channels, number = graph.convolution("pixels", "_conv_stem", "_bn0", stride=2), STEM_CHANNELS, 0
    for repeats, first_stride, expansion, out in STAGES:
        for stride in (first_stride, *[1] * (repeats - 1)):
            name, y = f"_blocks.{number}.", x
            if expansion > 1:
                y = graph.convolution(y, f"{name}_expand_conv", f"{name}_bn0")
            y = graph.convolution(y, f"{name}_depthwise_conv", f"{name}_bn1", stride)
            y = graph.convolution(y, f"{name}_project_conv", f"{name}_bn2", activation=False)
            x = graph.add("Add", y, x) if (stride, out) == (1, channels) else y
            channels, number = out, number + 1
    pooled = graph.add("GlobalAveragePool", graph.convolution(x, "_conv_head", "_bn1"))
    pixels = helper.make_tensor_value_info("pixels", onnx.TensorProto.FLOAT, [1, 3, INPUT_SIZE, INPUT_SIZE])
    features = helper.make_tensor_value_info(pooled, onnx.TensorProto.FLOAT, [1, 1280, 1, 1])
    made = helper.make_graph(graph.nodes, "efficientnet-lite0", [pixels], [features], graph.tensors)
    return helper.make_model(made, ir_version=10, opset_imports=[helper.make_opsetid("", 21)])


if __name__ == "__main__":
    onnx.save(build(Path(sys.argv[1])), Path(str(GRAPH)))
