"""Layers of the networks `learned_crop` and `learned_detect`: shapes of their weights, and graphs of ONNX operators.

Files are checked against these graphs and written from them (`networks`); `tools/crop_training.py` and
`tools/frame_training.py` train the same layers in PyTorch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.learned.network_input import FRAME_PLANES, PLANES, SCALARS, SIDE_PX

CROP, DETECT = "learned_crop", "learned_detect"
Weights = dict[str, NDArray[Any]]
"""Arrays by name, "<layer>.w" and "<layer>.b"."""

PLANES_OUT = 32
CONVOLUTIONS = (("c1", PLANES, 6, 2), *((name, PLANES_OUT, 3, 1) for name in ("c2", "c3", "c4")))
"""Of the network of crops: name, planes in, side of the kernel, step. No border: 8 x 8 cells in the middle are left."""
CELLS, FIRST_CELL_PX = 8, 8
REDUCED = 8
"""Planes of the cells that the dense layers get one by one."""
DENSE = (
    ("f1", SCALARS, 32),
    ("f2", 32, 2 * PLANES_OUT),
    ("d1", CELLS**2 * REDUCED + PLANES_OUT + SCALARS, 96),
    ("d2", 96, 5),
)
"""Matrices and their widths: gains and offsets of the first planes by the scalars, then the answer."""
CORRECTION_PX = 0.1
"""Of the place, per unit of the last layer."""
DETECTOR = (("e1", FRAME_PLANES, 12), ("e2", 12, 16), ("e3", 16, 16), ("e4", 16, 16))
"""Of the network of frames: name, planes in, planes out; 3 x 3 cells each, cut at 0; then one plane of 1 x 1."""


def weight_shapes(name: str) -> dict[str, tuple[int, ...]]:
    """Shapes of a network's weights by name."""
    if name == DETECT:
        sizes: list[tuple[str, tuple[int, ...], int]] = [(key, (to, of, 3, 3), to) for key, of, to in DETECTOR]
        sizes.append(("heat", (1, DETECTOR[-1][2], 1, 1), 1))
    else:
        sizes = [(key, (PLANES_OUT, of, side, side), PLANES_OUT) for key, of, side, _ in CONVOLUTIONS]
        sizes += [(key, (to, PLANES_OUT, 1, 1), to) for key, to in (("cells", 3), ("less", REDUCED))]
        sizes += [(key, (of, to), to) for key, of, to in DENSE]
    return {f"{key}{end}": shape for key, w, b in sizes for end, shape in ((".w", w), (".b", (b,)))}


def cell_places() -> NDArray[np.float32]:
    """Places (u, v) of the first pixels of all cells, shape (1, 2, cells)."""
    v, u = np.mgrid[:CELLS, :CELLS] * 2.0 + FIRST_CELL_PX
    return np.stack([u.ravel(), v.ravel()])[None].astype(np.float32)


@dataclass(frozen=True)
class Graph:
    """Nodes of a network, constants besides its weights, and shapes of its inputs and outputs."""

    nodes: list[Any]
    constants: Weights
    inputs: dict[str, list[str | int]]
    outputs: dict[str, list[str | int]]


def _crop_graph(helper: Any) -> Graph:
    """`crop_forward` in ONNX's operators."""
    node = helper.make_node
    nodes = [
        node("Gemm", ["scalars", "f1.w", "f1.b"], ["f1.x"]),
        node("Relu", ["f1.x"], ["f1.y"]),
        node("Gemm", ["f1.y", "f2.w", "f2.b"], ["f2.x"]),
        node("Reshape", ["f2.x", "film"], ["f2.y"]),
        node("Split", ["f2.y", "halves"], ["gain", "shift"], axis=1),
    ]
    x = "planes"
    for name, _, side, stride in CONVOLUTIONS:
        nodes.append(_convolved(helper, x, name, side, stride))
        x = f"{name}.x"
        if name == "c1":
            nodes += [node("Mul", [x, "gain"], ["gained"]), node("Add", ["gained", "shift"], ["moved_planes"])]
            x = "moved_planes"
        nodes.append(node("Relu", [x], [f"{name}.y"]))
        x = f"{name}.y"
    nodes += [
        _convolved(helper, x, "cells", 1),
        node("Reshape", ["cells.x", "three"], ["flat"]),
        node("Split", ["flat", "parts"], ["logit", "offset"], axis=1),
        node("Softmax", ["logit"], ["weight"], axis=2),
        node("Add", ["offset", "places"], ["placed"]),
        node("Mul", ["weight", "placed"], ["weighted"]),
        node("ReduceSum", ["weighted", "last"], ["middle"], keepdims=0),
        node("Reshape", [x, "many"], ["features"]),
        node("Mul", ["weight", "features"], ["attended"]),
        node("ReduceSum", ["attended", "last"], ["at_spot"], keepdims=0),
        _convolved(helper, x, "less", 1),
        node("Relu", ["less.x"], ["less.y"]),
        node("Flatten", ["less.y"], ["everywhere"], axis=1),
        node("Concat", ["at_spot", "everywhere", "scalars"], ["pooled"], axis=1),
        node("Gemm", ["pooled", "d1.w", "d1.b"], ["h"]),
        node("Relu", ["h"], ["h.y"]),
        node("Gemm", ["h.y", "d2.w", "d2.b"], ["y"]),
        node("Split", ["y", "ends"], ["moved", "factor"], axis=1),
        node("Mul", ["moved", "share"], ["correction"]),
        node("Add", ["middle", "correction"], ["uv_px"]),
    ]
    n = PLANES_OUT
    whole = {"three": [0, 3, -1], "many": [0, n, -1], "parts": [1, 2], "last": [2], "ends": [2, 3]}
    whole |= {"film": [0, 2 * n, 1, 1], "halves": [n, n]}
    constants: Weights = {key: np.array(value, np.int64) for key, value in whole.items()}
    constants |= {"places": cell_places(), "share": np.array(CORRECTION_PX, np.float32)}
    inputs: dict[str, list[str | int]] = {"planes": ["n", PLANES, SIDE_PX, SIDE_PX], "scalars": ["n", SCALARS]}
    return Graph(nodes, constants, inputs, {"uv_px": ["n", 2], "factor": ["n", 3]})


def _detect_graph(helper: Any) -> Graph:
    """`detector_forward` in ONNX's operators."""
    nodes, x = [], "planes"
    for name, _, _ in DETECTOR:
        nodes += [
            helper.make_node(
                "Conv", [x, f"{name}.w", f"{name}.b"], [f"{name}.x"], kernel_shape=[3, 3], pads=[1] * 4, strides=[1] * 2
            ),
            helper.make_node("Relu", [f"{name}.x"], [f"{name}.y"]),
        ]
        x = f"{name}.y"
    nodes.append(helper.make_node("Conv", [x, "heat.w", "heat.b"], ["heat"], kernel_shape=[1, 1]))
    return Graph(nodes, {}, {"planes": ["n", FRAME_PLANES, "h", "w"]}, {"heat": ["n", 1, "h", "w"]})


def _convolved(helper: Any, x: str, name: str, side: int, stride: int = 1) -> Any:
    """Node of a layer without a border; its result is "<name>.x"."""
    numbers = {"kernel_shape": [side] * 2, "strides": [stride] * 2}
    return helper.make_node("Conv", [x, f"{name}.w", f"{name}.b"], [f"{name}.x"], **numbers)


GRAPHS: Mapping[str, Callable[[Any], Graph]] = {CROP: _crop_graph, DETECT: _detect_graph}
"""By name; the argument makes nodes: `onnx.helper`, or what records them."""
