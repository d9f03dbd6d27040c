"""Networks in ONNX files: read, checked, run by onnxruntime, written; a spot's position from a crop; heat map peaks.

One thread: the same bytes every time.

A file ends with the SHA-256 of all that is before it. It is an entry of the model's metadata, so that other programs
read the file as they read any ONNX model. `tools/crop_training.py` and `tools/frame_training.py` make the weights.

A file may be a stranger's. Its size, its hash, its layers and its numbers are looked at before anything of it runs.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import MIB, InputFile
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.datasets.store.files import write_bytes
from phibench.estimator.interface import Image, Spot
from phibench.estimator.learned.network_file import NetworkFileError, Node, read_model, require_layers
from phibench.estimator.learned.network_graphs import CROP, DETECT, GRAPHS, Weights, weight_shapes
from phibench.estimator.learned.network_input import SIDE_PX, WINDOW_PX, CropInput, crop_input, crop_origin, cut_part
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.validation import printable_line

VERSIONS = {CROP: "4", DETECT: "1"}
"""Versions of what a network gets, of its layers and of what it answers; a change of any raises it."""
INSTALL = "pip install 'phibench[learned]'"
INSTALL_TRAINING = "pip install 'phibench[learned-training]' (the CPU's wheel of PyTorch is enough: docs/learned.md)"

_REMEDY = "install phibench anew, or train it: docs/learned.md"
_MOST_BYTES = MIB
_HASH = b"r\x4a\x0a\x06sha256\x12\x40"  # field 14 of a model, 74 bytes: the key, and a value of 64
_TAIL = len(_HASH) + 64
_SCALE = "covariance_scale"  # entry of the metadata: factor of the covariance
_MOST_LN = 50.0  # of a precision's factor: of deviations beyond e^-50 and e^50 px


class NetworkError(DatasetError):
    """A network that cannot be used; one sentence."""


SHIPPED = {
    CROP: "efdb43f114c59b1b4328bc1a9aa9e4a19ec3324277554f61b3db8a22cd255129",
    DETECT: "129ed24ca7641314eb8652bc81964e61873e5ef369ab8abb5add155e0441133a",
}
"""SHA-256 that the files of this release state; part of the code, so that a method's hash changes with its weights."""


def shipped_network(name: str) -> Network:
    """Network that comes with phibench.

    Raises
    ------
    NetworkError
        As of `Network`, or if the file belongs to another release.
    """
    return network(Path(__file__).with_name(f"{name}.onnx"), name, SHIPPED[name])


def sealed_model(model: bytes) -> bytes:
    """Model with the SHA-256 of its bytes at its end."""
    return model + _HASH + hashlib.sha256(model).hexdigest().encode()


@dataclass(frozen=True)
class Position:
    """Answer of the network for crops.

    Attributes
    ----------
    uv_px : shape (2,)
        Spot in the crop.
    covariance_px2 : shape (2, 2)
    """

    uv_px: Array
    covariance_px2: Array


class Network:
    """Network of a file.

    Parameters
    ----------
    name : `CROP` or `DETECT`
    sha256 : str, optional
        That the file must state.

    Raises
    ------
    NetworkError
        If onnxruntime is missing, or the file is damaged, of another version or no such network.
    """

    def __init__(self, path: Path, name: str, sha256: str | None = None) -> None:
        file = InputFile(path, _REMEDY, NetworkError, _MOST_BYTES)
        model = file.read()
        if model[-_TAIL:-64] != _HASH:
            raise file.fault("does not end as a network of phibench does")
        if model[-64:] != hashlib.sha256(model[:-_TAIL]).hexdigest().encode():
            raise file.fault("is damaged: its bytes do not have the SHA-256 that it states")
        self.sha256 = model[-64:].decode()
        if sha256 not in (None, self.sha256):
            raise file.fault("belongs to another release of phibench")
        try:
            self.metadata = _checked(model, name)
        except NetworkFileError as error:
            raise file.fault(str(error)) from error
        self._file, self._session = file, _session(model, file)

    def run(self, **inputs: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """Outputs for inputs with a leading axis of items."""
        try:
            return list(self._session.run(None, inputs))
        except Exception as error:  # its own kinds, some without a common base
            raise self._file.fault(f"cannot be run: {type(error).__name__}") from error

    @property
    def scale(self) -> float:
        """Factor of the covariance."""
        return float(self.metadata[_SCALE])

    def thresholds(self, kind: str) -> tuple[float, float]:
        """Least heat of a spot alone, and of one in each image, for a kind of images.

        Raises
        ------
        NetworkError
            If the network has none for them.
        """
        try:
            alone, each = (float(x) for x in json.loads(self.metadata["thresholds"])[kind])
        except (KeyError, TypeError, ValueError) as error:
            raise self._file.fault(f"has no two thresholds for {kind}") from error
        if not (math.isfinite(alone) and math.isfinite(each)):
            raise self._file.fault(f"has thresholds for {kind} that are not finite")
        return alone, each

    def position(self, crop: CropInput, scale: float | None = None) -> Position:
        """Position of the spot in a window, with its covariance; by default with the network's own scale.

        Means over the mirrored and turned views: what the network gets wrong in one, it often gets right in another.
        """
        views = crop.views
        planes = np.stack([view.of(crop.planes) for view in views])
        uv, factor = self.run(planes=planes, scalars=np.repeat(crop.scalars[None], len(views), axis=0))
        claimed = covariances(np.asarray(factor, float), self.scale if scale is None else scale)
        back = [view.matrix.T for view in views]
        places = [turn @ (place - MIDDLE_PX) for turn, place in zip(back, uv.astype(float), strict=True)]
        spreads = [turn @ one @ turn.T for turn, one in zip(back, claimed, strict=True)]
        return Position(np.mean(places, axis=0) + MIDDLE_PX, np.mean(spreads, axis=0))


def covariances(factors: Array, scale: float) -> Array:
    """Covariances, shape (n, 2, 2), px^2, of what the network answers.

    Parameters
    ----------
    factors : shape (n, 3)
        ln a, b, ln c of the precision's Cholesky factor ((a, 0), (b, c)).
    scale : float
        Factor of the covariance, from crops of rooms that were not trained in.
    """
    lower = np.zeros((len(factors), 2, 2))
    first, last = (np.exp(np.clip(factors[:, k], -_MOST_LN, _MOST_LN)) for k in (0, 2))
    lower[:, 0, 0], lower[:, 1, 0], lower[:, 1, 1] = first, factors[:, 1], last
    inverse = np.linalg.inv(lower)
    return np.asarray(scale * np.swapaxes(inverse, 1, 2) @ inverse)


@lru_cache(maxsize=8)
def network(path: Path, name: str, sha256: str | None = None) -> Network:
    """Network of a file, read once."""
    return Network(path, name, sha256)


def _checked(model: bytes, name: str) -> dict[str, str]:
    """Metadata of a model that has the layers of a network and only them.

    Raises
    ------
    NetworkFileError
        If it is not.
    """
    network = read_model(model)
    if network.metadata.get("name") != name:
        raise NetworkFileError(f"holds '{printable_line(str(network.metadata.get('name')), 40)}', not '{name}'")
    if network.metadata.get("version") != VERSIONS[name]:
        stated = printable_line(str(network.metadata.get("version")), 20)
        raise NetworkFileError(f"is of version {stated}, this phibench needs version {VERSIONS[name]}")
    graph = GRAPHS[name](_Recorder())
    for kind, given, right in (("inputs", network.inputs, graph.inputs), ("outputs", network.outputs, graph.outputs)):
        if given != list(right):
            raise NetworkFileError(
                f"has the {kind} {printable_line(', '.join(given), 60) or '-'}: {', '.join(right)} are needed"
            )
    require_layers(network, graph.nodes, weight_shapes(name), _OPSET)
    for key, value in graph.constants.items():
        if key not in network.tensors or not np.array_equal(network.tensors[key], value):
            raise NetworkFileError(f"has another constant '{key}' than this network")
    if strange := sorted(set(network.tensors) - set(graph.constants) - set(weight_shapes(name))):
        raise NetworkFileError(f"has the weights '{printable_line(strange[0], 40)}', which this network does not know")
    try:
        scale = float(network.metadata[_SCALE])
    except (KeyError, ValueError) as error:
        raise NetworkFileError(f"states no number {_SCALE}") from error
    if not 0.0 < scale < math.inf:
        raise NetworkFileError(f"states {_SCALE} = {scale:g}: a finite number above 0 is needed")
    return network.metadata


class _Recorder:
    """Nodes as `network_file.Node`, in place of onnx's helper."""

    def make_node(self, kind: str, inputs: Sequence[str], outputs: Sequence[str], **attributes: Any) -> Node:
        """One operator."""
        plain = {key: tuple(x) if isinstance(x, list) else int(x) for key, x in attributes.items()}
        return Node(kind, tuple(inputs), tuple(outputs), plain)


def _session(model: bytes, file: InputFile) -> Any:
    # from version 1.32 on it names the machine and reports its use, unless this is set before the import
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    try:
        import onnxruntime
    except ImportError as error:
        raise NetworkError(f"learned methods need onnxruntime: {INSTALL}") from error
    onnxruntime.set_default_logger_severity(4)
    onnxruntime.disable_telemetry_events()
    options = onnxruntime.SessionOptions()
    # several threads would add up in another order
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its own kinds, some without a common base
        raise file.fault("is no network that onnxruntime can run") from error


# -- writing ----------------------------------------------------------------------------------------------------------

_OPSET, _IR = 17, 8  # of 2022: what every onnxruntime of these years reads


def write_network(path: Path, name: str, weights: Weights, metadata: Mapping[str, Any]) -> Path:
    """Write the file of a network, and read it back.

    Parameters
    ----------
    name : `CROP` or `DETECT`
    metadata : entries besides name and version, such as "covariance_scale"

    Raises
    ------
    NetworkError
        If onnx is missing.
    """
    try:
        import onnx
        import onnx.checker
        import onnx.helper
        import onnx.numpy_helper
    except ImportError as error:
        raise NetworkError(f"writing networks needs onnx: {INSTALL_TRAINING}") from error
    graph = GRAPHS[name](onnx.helper)
    tensors = [onnx.numpy_helper.from_array(value, key) for key, value in (weights | graph.constants).items()]
    float_of = onnx.TensorProto.FLOAT
    ends = [
        [onnx.helper.make_tensor_value_info(key, float_of, shape) for key, shape in side.items()]
        for side in (graph.inputs, graph.outputs)
    ]
    made = onnx.helper.make_graph(graph.nodes, name, *ends, initializer=tensors)
    opset = [onnx.helper.make_operatorsetid("", _OPSET)]
    model = onnx.helper.make_model(made, opset_imports=opset, ir_version=_IR, producer_name="phibench")
    entries = {"name": name, "version": VERSIONS[name], **{key: str(value) for key, value in metadata.items()}}
    onnx.helper.set_model_props(model, entries)
    onnx.checker.check_model(model)
    write_bytes(path, sealed_model(model.SerializeToString(deterministic=True)))
    Network(path, name)
    return path


# -- spots of a pair -------------------------------------------------------------------------------------------------

MIDDLE_PX = (WINDOW_PX - 1) / 2.0
"""Of a window, about which its views are mirrored."""
_LOOKS = 3  # a crop about the place that the last one gave; the second is nearly always the same
_REACH_PX = 7.0  # of the crop's middle: farther away there are no cells


def refined_position(
    found: Network,
    image: Image,
    dark: Image | None,
    card: SensorCard,
    response: Sequence[float],
    uv_px: tuple[float, float],
    scale: float | None = None,
) -> Spot:
    """Position and covariance by the network of crops, from the crop about a place (u, v).

    Parameters
    ----------
    found : Network, of `CROP`
    image, dark : shape (H, W, ...)
        With the laser on, and off where there is such a frame.
    response : 3 floats
        Of the filters R, G, B at the laser's line.
    uv_px : (u, v)
    scale : float, optional
        Factor of the covariance instead of the network's.
    """
    origin = crop_origin(uv_px)
    for _ in range(_LOOKS):
        made = crop_input(cut_part(image, origin), None if dark is None else cut_part(dark, origin), card, response)
        answer = found.position(made, scale)
        if not np.abs(answer.uv_px - (SIDE_PX - 1) / 2.0).max() < _REACH_PX:
            return Spot.missing("no spot near the place")
        u, v = (float(x) for x in answer.uv_px + origin)
        if (again := crop_origin((u, v))) == origin:
            break
        origin = again
    height, width = image.shape[:2]
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        return Spot.missing("spot cut")
    (a, b), (_, c) = answer.covariance_px2.tolist()
    return Spot((u, v), ((a, b), (b, c)))


@dataclass(frozen=True)
class HeatPeaks:
    """Peaks of a map of heat.

    Attributes
    ----------
    cells : shape (n, 2)
        Places (u, v), cells of 2 x 2 pixels.
    heat : shape (n,)
    red_e : shape (n,)
        Red light about them, mean electrons of 5 x 5 cells.
    """

    cells: Array
    heat: Array
    red_e: Array


_NEAR = 5  # cells along a side: one spot


def heat_peaks(heat: Array, red_e: Array, inside: BoolArray, least: float) -> HeatPeaks:
    """Peaks above a level in the part that is asked for; heat, light and part have the shape (h, w)."""
    heat = np.where(inside, heat, -np.inf)
    v, u = np.nonzero((heat >= least) & (heat == maximum_filter(heat, _NEAR)))
    return HeatPeaks(np.stack([u, v], axis=1).astype(float), heat[v, u], uniform_filter(red_e, _NEAR)[v, u])
