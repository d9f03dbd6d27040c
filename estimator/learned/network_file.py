"""Contents of an ONNX file, parsed without a package and without running it; refusal of other layers than expected.

A model of a stranger can name other files for its weights, make tensors of any size, or lack what is asked of it. Here
everything is compared with the layers of a network of phibench; only the numbers in the weights are free.

ONNX is a Protocol Buffers message (onnx.proto): fields of a number and a type, in any order. Fields that no network of
phibench has are refused, so that nothing is left that could mean something else.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5  # types of fields
_EXTERNAL = (13, 14)  # of a tensor: external_data, data_location
_TYPES = {1: "<f4", 7: "<i8"}  # of a tensor: FLOAT, INT64
_MOST_DIMS = 8


class NetworkFileError(ValueError):
    """A fault of a file, in words that follow its name."""


@dataclass(frozen=True)
class Node:
    """One operator; attributes are whole numbers, or tuples of them."""

    kind: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, int | tuple[int, ...]]


@dataclass(frozen=True)
class OnnxModel:
    """Everything in an ONNX file that counts."""

    nodes: list[Node] = field(default_factory=list)
    tensors: dict[str, NDArray[Any]] = field(default_factory=dict)
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    metadata: dict[str, str] = field(default_factory=dict)
    opsets: list[tuple[str, int]] = field(default_factory=list)


def read_model(data: bytes) -> OnnxModel:
    """Contents of a file.

    Raises
    ------
    NetworkFileError
        If it is no ONNX model, or has a part that no network of phibench has.
    """
    model = OnnxModel()
    try:
        _model(model, memoryview(data))
    except (IndexError, UnicodeDecodeError, OverflowError) as error:
        raise NetworkFileError("is no ONNX model, or is cut off") from error
    return model


def require_layers(model: OnnxModel, nodes: list[Node], shapes: Mapping[str, tuple[int, ...]], opset: int) -> None:
    """Refuse a model that is not of these layers.

    Parameters
    ----------
    model : OnnxModel
    nodes : operators in their order
    shapes : mapping
        Of the weights, by name; all are float32 and finite.
    opset : version of the operators

    Raises
    ------
    NetworkFileError
        If an operator, a tensor, its type, its shape or a number in it is not as it has to be.
    """
    if model.opsets != [("", opset)]:
        raise NetworkFileError(f"uses other operators than ONNX's of version {opset}")
    if model.nodes != nodes:
        strange = {node.kind for node in model.nodes} - {node.kind for node in nodes}
        more = f": it has {', '.join(sorted(strange)[:3])}" if strange else ""
        raise NetworkFileError(f"has other layers than this network{more}")
    for name, shape in shapes.items():
        tensor = model.tensors.get(name)
        if tensor is None or tensor.dtype != np.float32 or tensor.shape != shape:
            raise NetworkFileError(f"has no weights '{name}' of the shape {shape} in single precision")
        if not np.isfinite(tensor).all():
            raise NetworkFileError(f"has weights '{name}' that are not finite")


# -- the message ------------------------------------------------------------------------------------------------------


def _model(model: OnnxModel, data: memoryview) -> None:
    for number, value in _fields(data):
        if number == 7:
            _graph(model, _bytes(value))
        elif number == 8:
            parts = dict(_fields(_bytes(value)))
            model.opsets.append((_text(parts.get(1, b"")), _whole(parts.get(2, 0))))
        elif number == 14:
            entry = dict(_fields(_bytes(value)))
            key = _text(entry.get(1, b""))
            if key in model.metadata:
                raise NetworkFileError(f"has the entry '{key[:20]}' twice")
            model.metadata[key] = _text(entry.get(2, b""))
        elif number not in (1, 2, 3):  # version of the format, producer and its version
            raise NetworkFileError(f"has a part (field {number} of the model) that no network of phibench has")


def _graph(model: OnnxModel, data: memoryview) -> None:
    for number, value in _fields(data):
        if number == 1:
            model.nodes.append(_node(_bytes(value)))
        elif number == 5:
            name, tensor = _tensor(_bytes(value))
            if name in model.tensors:
                raise NetworkFileError(f"has the weights '{name[:20]}' twice")
            model.tensors[name] = tensor
        elif number in (11, 12):
            names = model.inputs if number == 11 else model.outputs
            names.append(_text(dict(_fields(_bytes(value))).get(1, b"")))
        elif number != 2:  # its name
            raise NetworkFileError(f"has a part (field {number} of the graph) that no network of phibench has")


def _node(data: memoryview) -> Node:
    names: dict[int, list[str]] = {1: [], 2: [], 3: [], 4: [], 7: []}
    attributes: dict[str, int | tuple[int, ...]] = {}
    for number, value in _fields(data):
        if number == 5:
            key, numbers = _attribute(_bytes(value))
            attributes[key] = numbers
        elif number in names:
            names[number].append(_text(value))
        else:
            raise NetworkFileError(f"has a part (field {number} of a layer) that no network of phibench has")
    if names[7] not in ([], [""]) or len(names[4]) != 1:
        raise NetworkFileError("has a layer that is not ONNX's own")
    return Node(names[4][0], tuple(names[1]), tuple(names[2]), attributes)


def _attribute(data: memoryview) -> tuple[str, int | tuple[int, ...]]:
    name, single, several = "", None, list[int]()
    for number, value in _fields(data):
        if number == 1:
            name = _text(value)
        elif number == 3:
            single = _signed(_whole(value))
        elif number == 8:
            several += _numbers(value)
        elif number != 20:  # its type
            raise NetworkFileError("has a layer with an attribute that is no whole number")
    return name, tuple(several) if single is None else single


def _tensor(data: memoryview) -> tuple[str, NDArray[Any]]:
    dims, kind, name, raw = list[int](), 0, "", b""
    for number, value in _fields(data):
        if number == 1:
            dims += _numbers(value)
        elif number == 2:
            kind = _whole(value)
        elif number == 8:
            name = _text(value)
        elif number == 9:
            raw = bytes(_bytes(value))
        elif number in _EXTERNAL:
            raise NetworkFileError("keeps weights in another file: give a network with its weights inside")
        else:
            raise NetworkFileError(f"has weights in a form (field {number}) that no network of phibench has")
    if kind not in _TYPES or len(dims) > _MOST_DIMS or any(n < 0 for n in dims):
        raise NetworkFileError(f"has weights '{name[:20]}' of a type or shape that no network of phibench has")
    if math.prod(dims) * np.dtype(_TYPES[kind]).itemsize != len(raw):
        raise NetworkFileError(f"has weights '{name[:20]}' of another size than their shape")
    return name, np.frombuffer(raw, _TYPES[kind]).reshape(dims)


# -- fields -----------------------------------------------------------------------------------------------------------

Value = int | memoryview


def _fields(data: memoryview) -> Iterator[tuple[int, Value]]:
    """Fields of a message: numbers of a field, and a whole number or bytes."""
    place = 0
    while place < len(data):
        key, place = _varint(data, place)
        kind = key & 7
        if kind == _VARINT:
            value, place = _varint(data, place)
            yield key >> 3, value
            continue
        if kind == _LENGTH:
            size, place = _varint(data, place)
        elif kind in (_FIXED64, _FIXED32):
            size = 8 if kind == _FIXED64 else 4
        else:
            raise NetworkFileError("is no ONNX model")
        if size > len(data) - place:
            raise NetworkFileError("is no ONNX model, or is cut off")
        yield key >> 3, data[place : place + size]
        place += size


def _varint(data: memoryview, place: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = data[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place
    raise NetworkFileError("is no ONNX model")


def _numbers(value: Value) -> list[int]:
    """Whole numbers of a repeated field, packed or one by one."""
    if isinstance(value, int):
        return [_signed(value)]
    numbers, place = list[int](), 0
    while place < len(value):
        number, place = _varint(value, place)
        numbers.append(_signed(number))
    return numbers


def _signed(value: int) -> int:
    return value - (1 << 64) if value >= 1 << 63 else value


def _whole(value: Value | bytes) -> int:
    if not isinstance(value, int):
        raise NetworkFileError("is no ONNX model")
    return value


def _bytes(value: Value | bytes) -> memoryview:
    if isinstance(value, int):
        raise NetworkFileError("is no ONNX model")
    return memoryview(value)


def _text(value: Value | bytes) -> str:
    return bytes(_bytes(value)).decode()
