"""Document of a glTF file (`GltfDocument`): checked JSON values, chunks of a .glb, buffers, and arrays of accessors.

glTF 2.0, sections 3.6 and 4 (Khronos Group, 2021; ISO/IEC 12113:2022). Every number of the document is looked at before
it is used: the file is a stranger's.
"""

from __future__ import annotations

import base64
import binascii
import codecs
import math
import urllib.parse
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.input_files import InputFile
from phibench.datasets.rooms.mesh_parts import MOST_TRIANGLES, Companions, damage_error
from phibench.scenes.frames import Array
from phibench.scenes.validation import printable_line

_KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}  # componentType of glTF
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MOST_ENTRIES = 3 * MOST_TRIANGLES  # each corner a place of its own
_MOST_READ = 8 * MOST_ENTRIES  # of all arrays: places, corners, colours and texture coordinates, most of them twice


class GltfDocument:
    """Document of a glTF file and the bytes behind it.

    Parameters
    ----------
    file : InputFile
    companions : Companions

    Raises
    ------
    RoomError
        If it is damaged.
    """

    def __init__(self, file: InputFile, companions: Companions) -> None:
        self.file, self.companions = file, companions
        data, self._binary = file.read(), b""
        if data[:4] == b"glTF":
            text, self._binary = self._chunks(data)
            self.tree = file.json(text)
        else:
            self.tree = file.json(data.removeprefix(codecs.BOM_UTF8))  # of editors of Windows
        version = self.table(self.tree, "asset").get("version", "2.0")
        least = self.table(self.tree, "asset").get("minVersion", "2.0")
        if not str(version).startswith("2.") or least != "2.0":
            raise file.fault(f"is glTF {printable_line(str(version), 10)} or needs {least!s:.10}: 2.0 is read")
        self._buffers: dict[int, bytes] = {}
        self._rows: dict[str, list[dict[str, Any]]] = {}
        self._read = 0

    def _chunks(self, data: bytes) -> tuple[bytes, bytes]:
        """Text and binary chunk of a .glb file."""
        chunks: dict[bytes, bytes] = {}
        version, length = (int.from_bytes(data[at : at + 4], "little") for at in (4, 8))
        if version != 2:
            raise self.file.fault(f"is a .glb of the version {version}: 2 is read")
        if length > len(data):
            raise self.file.fault(f"is damaged: it has {len(data)} of {length} bytes")
        at, data = 12, data[:length]  # after magic, version and length
        while at + 8 <= len(data):  # of a chunk, length and kind come first
            length, kind = int.from_bytes(data[at : at + 4], "little"), data[at + 4 : at + 8]
            if at + 8 + length > len(data):
                raise self.file.fault("is damaged: it ends within a chunk")
            chunks.setdefault(kind, data[at + 8 : at + 8 + length])
            at += 8 + length
        if b"JSON" not in chunks:
            raise self.file.fault("is damaged: it has no JSON chunk")
        return chunks[b"JSON"], chunks.get(b"BIN\0", b"")

    # Values of the document.

    def rows(self, key: str) -> list[dict[str, Any]]:
        """List of tables at the root."""
        if key not in self._rows:  # looked at once: a thousand nodes ask for it a thousand times
            entries = self.tree.get(key, [])
            if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
                raise self.file.fault(f"is damaged: '{key}' is not a list of tables")
            self._rows[key] = entries
        return self._rows[key]

    def row(self, key: str, number: Any) -> dict[str, Any]:
        """Table by its number in a list at the root."""
        rows = self.rows(key)
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < len(rows):
            raise self.file.fault(
                f"is damaged: it names number {number!s:.20} of its {key}, of which it has {len(rows)}"
            )
        return rows[number]

    def table(self, owner: dict[str, Any], key: str) -> dict[str, Any]:
        """Table within a table; an empty one where there is none."""
        value = owner.get(key, {})
        if not isinstance(value, dict):
            raise self.file.fault(f"is damaged: '{key}' is not a table")
        return value

    def numbers(self, owner: dict[str, Any], key: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """Numbers of a list of fixed length."""
        values = owner.get(key, list(default))
        is_plain = isinstance(values, list) and len(values) == len(default)
        if not is_plain or not all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in values):
            raise self.file.fault(f"is damaged: '{key}' is not {len(default)} numbers")
        return tuple(float(x) for x in values)

    def whole(self, owner: dict[str, Any], key: str, default: int | None = None, most: int = 2**40) -> int:
        """Whole number from 0 up."""
        number = owner.get(key, default)
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= most:
            raise self.file.fault(f"is damaged: '{key}' is {number!s:.20}, not a whole number from 0 to {most}")
        return number

    def number(self, owner: dict[str, Any], key: str, default: float, least: float = 0.0) -> float:
        """Number from a least one up; glTF has no text and no truth value in its place."""
        value = owner.get(key, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value < math.inf:
            raise self.file.fault(f"is damaged: '{key}' is {value!r:.20}, not a number from {least:g} up")
        return float(value)

    def truth(self, owner: dict[str, Any], key: str, default: bool) -> bool:
        """True or false, never a text or number in its place."""
        value = owner.get(key, default)
        if not isinstance(value, bool):
            raise self.file.fault(f"is damaged: '{key}' is {value!r:.20}, not true or false")
        return value

    # Bytes and arrays.

    def view(self, number: Any) -> tuple[memoryview, int]:
        """Bytes of a buffer view, not copied, and its stride, 0 where it states none."""
        view = self.row("bufferViews", number)
        if any("meshopt" in name for name in self.table(view, "extensions")):  # of EXT and of KHR
            raise self.file.fault("has arrays compressed by meshopt: `gltf-transform cp IN.glb OUT.glb` unpacks them")
        data = self._buffer(self.whole(view, "buffer"))
        start, length = self.whole(view, "byteOffset", 0), self.whole(view, "byteLength")
        if start + length > len(data):
            raise damage_error(self.file)
        return memoryview(data)[start : start + length], self.whole(
            view, "byteStride", 0, 252
        )  # 252: glTF's largest stride

    def _buffer(self, number: int) -> bytes:
        if number not in self._buffers:
            buffer = self.row("buffers", number)
            uri = buffer.get("uri")
            data = self._binary if uri is None and number == 0 else self.of_uri(uri)
            length = self.whole(buffer, "byteLength")
            if length > len(data):
                raise damage_error(self.file)
            self._buffers[number] = data[:length]
        return self._buffers[number]

    def of_uri(self, uri: Any) -> bytes:
        """Bytes that a URI names: in itself, or a file."""
        if not isinstance(uri, str):
            raise damage_error(self.file)
        if not uri.startswith("data:"):
            return self.companions.named(uri, is_uri=True).read()
        head, comma, text = uri.partition(",")
        if not comma:
            raise damage_error(self.file)
        raw = urllib.parse.unquote_to_bytes(text)  # RFC 2397: bytes as %XX, or base64
        if not head.endswith(";base64"):
            return raw
        try:
            return base64.b64decode(raw, validate=True)
        except (binascii.Error, ValueError) as error:
            raise damage_error(self.file) from error

    def array(self, number: Any, width: int | tuple[int, ...]) -> Array:
        """Entries of an accessor, shape (count, width), as floats; normalised whole numbers span 0 or -1 to 1."""
        raw, accessor = self.raw_array(number, width), self.row("accessors", number)
        values = raw.astype(float)
        if self.truth(accessor, "normalized", False) and raw.dtype.kind in "iu":
            values = np.maximum(values / np.iinfo(raw.dtype).max, -1.0)
        return values

    def raw_array(self, number: Any, width: int | tuple[int, ...]) -> NDArray[Any]:
        """Entries of an accessor as they are stored, shape (count, width)."""
        accessor = self.row("accessors", number)
        count = accessor.get("count", 0)
        if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= MOST_ENTRIES:
            raise self.file.fault(f"has an array of {count!s:.20} entries: at most {MOST_ENTRIES} are read")
        wide, kind = _WIDTHS.get(accessor.get("type", "")), _KINDS.get(accessor.get("componentType", 0))
        if wide is None or kind is None or wide not in ((width,) if isinstance(width, int) else width):
            raise self.file.fault(f"is damaged: accessor {number} has a type that its use does not allow")
        self._read += count  # an array that many parts share is read for each of them
        if self._read > _MOST_READ:
            raise self.file.fault(f"has arrays of more than {_MOST_READ} entries together: at most that many are read")
        values = np.zeros((count, wide), kind)
        if "bufferView" in accessor:
            data, stride = self.view(accessor["bufferView"])
            values = self._strided(data, self.whole(accessor, "byteOffset", 0), stride, (count, wide), kind)
        if "sparse" in accessor:
            values = self._with_sparse(self.table(accessor, "sparse"), values)
        return values

    def _strided(self, data: memoryview, start: int, stride: int, shape: tuple[int, int], kind: str) -> NDArray[Any]:
        size = np.dtype(kind).itemsize * shape[1]
        step = stride or size
        if shape[0] and (step < size or start + step * (shape[0] - 1) + size > len(data)):
            raise damage_error(self.file)
        if not shape[0]:
            return np.zeros(shape, kind)
        return np.ndarray(shape, kind, data, start, (step, np.dtype(kind).itemsize)).copy()

    def _with_sparse(self, sparse: dict[str, Any], values: NDArray[Any]) -> NDArray[Any]:
        count = self.whole(sparse, "count", None, len(values))
        places, entries = self.table(sparse, "indices"), self.table(sparse, "values")
        kind = _KINDS.get(places.get("componentType", 0))
        if kind is None or kind[1] != "u":
            raise damage_error(self.file)
        index = self._strided(*self._sparse_view(places), 0, (count, 1), kind)[:, 0].astype(np.int64)
        new = self._strided(*self._sparse_view(entries), 0, (count, values.shape[1]), values.dtype.str)
        if count and (index.max() >= len(values) or (np.diff(index) <= 0).any()):
            raise damage_error(self.file)
        values = values.copy()
        values[index] = new
        return values

    def _sparse_view(self, owner: dict[str, Any]) -> tuple[memoryview, int]:
        data, _ = self.view(owner.get("bufferView"))
        return data, self.whole(owner, "byteOffset", 0)
