"""A network in an ONNX file as a recogniser. A small one is made here; yours comes from torch.onnx.export.

pip install '.[onnx]' onnx
python examples/own_network.py LOG FOLDER [SETTING=VALUE ...]
"""

import sys
from pathlib import Path

import onnx
from onnx import TensorProto, helper

import vplog

path, folder, *settings = sys.argv[1:]
file = Path(folder) / "means.onnx"
nodes = [
    helper.make_node("AveragePool", ["image"], ["means"], kernel_shape=[28, 28], strides=[28, 28]),
    helper.make_node("Flatten", ["means"], ["vector"]),
]
image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 224, 224])
vector = helper.make_tensor_value_info("vector", TensorProto.FLOAT, [1, 192])
graph = helper.make_graph(nodes, "means", [image], [vector])
onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), file)
file.with_suffix(".yaml").write_text("size: [224, 224]\nmean: [0.5, 0.5, 0.5]\nstd: [0.25, 0.25, 0.25]\n")

found = vplog.compare(
    path, methods=["gist", f"onnx:{file}"], truth="poses", min_gap=15, library_size=4, settings=settings
)
for name, figures in found.record["methods"].items():
    print(f"{name} recall at 1: {figures['r_at_1']:.2f}, {figures['bits']} bits a place")
