"""Small networks, made and exported here: mean colours of blocks for places, corners for local features."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from pathlib import Path

    import onnx

    from vplog.data import Bytes

SIZE, BLOCK = 32, 8
YAML = f"size: [{SIZE}, {SIZE}]\nmean: [0, 0, 0]\nstd: [1, 1, 1]\n"


def helper() -> type[onnx.helper]:  # type: ignore[name-defined]
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed: pip install onnxruntime")
    return pytest.importorskip("onnx", reason="onnx, which makes the networks, is not installed").helper


def save(folder: Path, model: object, name: str, yaml: str | None) -> Path:
    path = folder / f"{name}.onnx"
    path.write_bytes(model.SerializeToString())  # type: ignore[attr-defined]
    if yaml is not None:
        path.with_suffix(".yaml").write_text(yaml)
    return path


def block_means(folder: Path, name: str = "means", yaml: str | None = YAML, channels: int = 3) -> Path:
    """(1, C, H, W) to the mean of each channel in blocks of 8 x 8 px, less half: (1, C * blocks)."""
    make = helper()
    tensor = make.make_tensor_value_info
    nodes = [
        make.make_node("AveragePool", ["image"], ["means"], kernel_shape=[BLOCK, BLOCK], strides=[BLOCK, BLOCK]),
        make.make_node("Flatten", ["means"], ["flat"]),
        make.make_node("Constant", [], ["half"], value=make.make_tensor("half", 1, [1], [0.5])),
        make.make_node("Sub", ["flat", "half"], ["vector"]),
    ]
    graph = make.make_graph(
        nodes, "means", [tensor("image", 1, [1, channels, "h", "w"])], [tensor("vector", 1, [1, "d"])]
    )
    return save(folder, make.make_model(graph, opset_imports=[make.make_opsetid("", 17)], ir_version=9), name, yaml)


def block_means_of(image: Bytes) -> np.ndarray:
    """What the network gives of (SIZE, SIZE, C) pixels, without it."""
    pixels = image.astype(np.float32) / 255
    blocks = pixels.reshape(SIZE // BLOCK, BLOCK, SIZE // BLOCK, BLOCK, -1).mean(axis=(1, 3))
    return blocks.transpose(2, 0, 1).reshape(-1) - np.float32(0.5)


LOCAL_YAML = "colour: grey\nmean: [0]\nstd: [1]\nscores: scores\n"


def corners(folder: Path, name: str = "corners", yaml: str = LOCAL_YAML, values: int = 32, count: int = 300) -> Path:
    """(1, 1, H, W) to Harris corners: keypoints (1, K, 2), scores (K,), and descriptors (D, K), the patch around each
    through random filters."""
    make, rng = helper(), np.random.default_rng(0)
    blur = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1]) / 256
    slope = np.outer([1, 2, 1], [-1, 0, 1]) / 8
    filters = rng.standard_normal((values, 1, 15, 15))
    filters -= filters.mean(axis=(2, 3), keepdims=True)
    known = {
        "along_x": slope[None, None], "along_y": slope.T[None, None], "blur": blur[None, None], "filters": filters,
        "part": np.array(0.05), "none": np.array(0.0),
    }  # fmt: skip
    numbers = {"whole": [-1], "rows": [values, -1], "three": [3], "count": [count], "last": [1]}

    def convolved(image: str, kernel: str, out: str, size: int) -> object:
        return make.make_node("Conv", [image, kernel], [out], kernel_shape=[size, size], pads=[size // 2] * 4)

    nodes = [
        convolved("image", "along_x", "x", 3), convolved("image", "along_y", "y", 3),
        *(make.make_node("Mul", [a, b], [a + b]) for a, b in ("xx", "yy", "xy")),
        *(convolved(two, "blur", f"b{two}", 5) for two in ("xx", "yy", "xy")),
        make.make_node("Mul", ["bxx", "byy"], ["product"]), make.make_node("Mul", ["bxy", "bxy"], ["square"]),
        make.make_node("Sub", ["product", "square"], ["determinant"]),
        make.make_node("Add", ["bxx", "byy"], ["trace"]), make.make_node("Mul", ["trace", "trace"], ["trace2"]),
        make.make_node("Mul", ["trace2", "part"], ["edge"]), make.make_node("Sub", ["determinant", "edge"], ["corner"]),
        make.make_node("MaxPool", ["corner"], ["best"], kernel_shape=[7, 7], pads=[3] * 4, strides=[1, 1]),
        make.make_node("Equal", ["corner", "best"], ["is_best"]),
        make.make_node("Where", ["is_best", "corner", "none"], ["kept"]),
        make.make_node("Reshape", ["kept", "whole"], ["flat"]),
        make.make_node("TopK", ["flat", "count"], ["scores", "at"]),
        make.make_node("Shape", ["image"], ["shape"]), make.make_node("Gather", ["shape", "three"], ["width"]),
        make.make_node("Div", ["at", "width"], ["row"]), make.make_node("Mod", ["at", "width"], ["column"]),
        make.make_node("Unsqueeze", ["row", "last"], ["r"]), make.make_node("Unsqueeze", ["column", "last"], ["c"]),
        make.make_node("Concat", ["c", "r"], ["pair"], axis=1), make.make_node("Cast", ["pair"], ["points"], to=1),
        make.make_node("Unsqueeze", ["points", "zero"], ["keypoints"]),
        convolved("image", "filters", "described", 15), make.make_node("Reshape", ["described", "rows"], ["table"]),
        make.make_node("Gather", ["table", "at"], ["descriptors"], axis=1),
    ]  # fmt: skip
    numbers["zero"] = [0]
    constants = [
        make.make_tensor(key, 1, value.shape, value.astype(np.float32).ravel()) for key, value in known.items()
    ]
    constants += [make.make_tensor(key, 7, [len(value)], value) for key, value in numbers.items()]
    tensor = make.make_tensor_value_info
    outputs = [tensor("keypoints", 1, None), tensor("scores", 1, None), tensor("descriptors", 1, None)]
    graph = make.make_graph(nodes, "corners", [tensor("image", 1, [1, 1, "h", "w"])], outputs, constants)
    return save(folder, make.make_model(graph, opset_imports=[make.make_opsetid("", 17)], ir_version=9), name, yaml)
