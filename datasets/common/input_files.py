"""Input files read within bounds (text, JSON, TOML, Parquet, arrays, pictures), and types of bounded names and texts.

Every file that somebody else may have written goes through `InputFile`. It looks at the kind and the size of a file
before it reads, bounds depth, numbers and texts of a document, and compares it with a model. A fault is one sentence:
the file, the place in it, and what to do.

A name in a document that leads to another file is a `FileName`: relative, below the folder, without "..".
"""

from __future__ import annotations

import codecs
import contextlib
import io
import json
import math
import os
import re
import stat
import tomllib
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast

from pydantic import AfterValidator, BaseModel, Field, ValidationError

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.toml_advice import toml_advice
from phibench.scenes.validation import printable_line

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from PIL.Image import Image
    from polars import DataFrame, DataType

MIB = 1 << 20
DOCUMENT_BYTES = 512 * MIB  # a submission of 1e6 pairs has 400 MiB
SETTINGS_BYTES = 1 * MIB  # TOML and other files that people write
TABLE_ROWS = 20_000_000  # ten times those of a score of 1e6 pairs
TABLE_VALUES = 500_000_000  # rows times columns; a column of one value takes no room in the file, but in memory
PICTURE_PIXELS = 50_000_000  # of one picture: a small file may unpack to gigabytes
DEPTH = 64  # of lists and tables in each other
DIGITS = 40  # of a whole number; a seed of 128 bits has 39
NAME_LENGTH = 200  # of a key, and of a name of ours
KEY_PARTS = 32  # of a dotted key of TOML

FILE_NAME = r"[A-Za-z0-9_][A-Za-z0-9_.+-]*(?:/[A-Za-z0-9_][A-Za-z0-9_.+-]*)*"


N = TypeVar("N", str, str | None)


def _below(name: N) -> N:
    if name is not None and (len(name) > NAME_LENGTH or not re.fullmatch(FILE_NAME, name)):
        raise ValueError(f"{printable_line(name, 60)!r} is no name of a file below the folder")
    return name


FileName = Annotated[str, AfterValidator(_below)]
NoFileName = Annotated[str | None, AfterValidator(_below)]
"""Name of a file relative to the folder of its document: no absolute path, and no part that begins with a dot."""


def path_below(folder: Path, name: str) -> Path:
    """Path of a file below a folder that somebody else may have filled.

    Raises
    ------
    DatasetError
        If a link leads out of the folder: what lies there would become part of what is made of it.
    """
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise DatasetError(f"{path} is a link that leads out of {folder}; put the file itself there")
    return path


_PART = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*\.[ \t]*{_PART}){{{KEY_PARTS},}}")

M = TypeVar("M", bound=BaseModel)


def _shown(text: str) -> str:
    return printable_line(text, 2000)


Text = Annotated[str, AfterValidator(_shown)]
"""Text of somebody else in a document: escaped and cut, never refused."""


def _plain(text: str) -> str:
    if not text.isprintable():
        raise ValueError("a control character or a line break in a name")
    return text


Name = Annotated[str, Field(max_length=NAME_LENGTH), AfterValidator(_plain)]
"""Name in a document: one line of at most 200 characters; one with control characters is refused."""


def first_fault(error: ValidationError) -> str:
    """Place and message of the first fault that pydantic found."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    where = ".".join(map(str, first["loc"]))
    text = "there is no such field" if first["type"] == "extra_forbidden" else first["msg"]
    return printable_line(f"{where}: {text}" if where else text, 300)


@dataclass(frozen=True)
class InputFile:
    """A file that is to be read.

    Parameters
    ----------
    remedy : str
        End of every sentence about a fault: what to do.
    error : type of the error
    limit_bytes : int
        Largest size that is read.
    """

    path: Path
    remedy: str
    error: type[DatasetError] = DatasetError
    limit_bytes: int = DOCUMENT_BYTES

    def fault(self, text: str) -> DatasetError:
        """Error with one sentence about the file."""
        path = str(self.path)
        return self.error(f"{path if path.isprintable() else printable_line(path)} {text}; {self.remedy}")

    def read(self) -> bytes:
        """All bytes.

        Raises
        ------
        DatasetError
            If there is no such file, it is a folder, a pipe or a device, too large, or cannot be read.
        """
        try:
            # a pipe without a writer would be waited for
            handle = os.open(self.path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
            try:
                return self._bounded(handle)
            finally:
                os.close(handle)
        except FileNotFoundError as error:
            raise self.fault("is missing") from error
        except (OSError, ValueError) as error:
            if isinstance(error, DatasetError):
                raise
            raise self.fault(f"is not readable: {getattr(error, 'strerror', None) or error}") from error

    def _bounded(self, handle: int) -> bytes:
        status = os.fstat(handle)
        if stat.S_ISDIR(status.st_mode):
            raise self.fault("is not readable: it is a folder")
        if not stat.S_ISREG(status.st_mode):
            raise self.fault("is not readable: it is no ordinary file")
        with os.fdopen(handle, "rb", closefd=False) as file:
            # not the limit at once, for which memory would be asked; files of the system may tell a size of 0
            most = min(max(status.st_size, MIB), self.limit_bytes) + 1
            data = b"" if status.st_size > self.limit_bytes else file.read(most)
        if max(status.st_size, len(data)) > self.limit_bytes:
            raise self.fault(f"is larger than {self.limit_bytes / MIB:.0f} MiB, the most that is read of its kind")
        return data

    @contextlib.contextmanager
    def decoding(self, what: str) -> Iterator[None]:
        """Whatever a decoder raises becomes a sentence "`what`: reason"; its faults are of many kinds.

        A lack of memory is no fault of the file and goes on as it is.
        """
        try:
            yield
        except (DatasetError, MemoryError):
            raise
        except Exception as error:
            reason = printable_line(str(error).partition("\n")[0], 200) or type(error).__name__
            raise self.fault(f"{what}: {reason}") from error

    # Documents.

    def text(self, data: bytes | None = None, encoding: str = "utf-8") -> str:
        """Text of the file, or of bytes that are already read from it; a byte order mark of UTF-16 is obeyed."""
        data = self.read() if data is None else data
        if len(data) > 2 and data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):  # of Windows
            encoding = "utf-32" if data.startswith(codecs.BOM_UTF32_LE) else "utf-16"
        elif data[1:2] == b"\0":
            encoding = "utf-16-le"
        try:
            return data.decode(encoding)
        except UnicodeDecodeError as error:
            raise self.fault(
                f"cannot be read: byte {error.start} is not {encoding.removesuffix('-sig').upper()}; save it as UTF-8"
            ) from error

    def json(self, data: bytes | None = None) -> dict[str, Any]:
        """JSON object, bounded.

        Raises
        ------
        DatasetError
            If it is not JSON or no object, holds a key twice, or is beyond the bounds.
        """
        try:
            document = json.loads(self.text(data), object_pairs_hook=_without_twins)
        except RecursionError as error:
            raise self.fault(f"is damaged: it is nested deeper than {DEPTH} levels") from error
        except ValueError as error:
            if isinstance(error, DatasetError):
                raise
            raise self.fault(f"is damaged: it is not JSON ({printable_line(str(error), 200)})") from error
        if not isinstance(document, dict):
            raise self.fault("is damaged: it does not hold a JSON object")
        if fault := bounds_fault(document):
            raise self.fault(f"is damaged: {fault}")
        return document

    def toml(self, data: bytes | None = None) -> dict[str, Any]:
        """Tables of a TOML file, bounded; numbers may be infinite or NaN, which a model refuses by name."""
        return self.toml_of(self.text(data, "utf-8-sig"))  # some editors put a byte order mark first

    def toml_of(self, text: str) -> dict[str, Any]:
        """Tables of a TOML text."""
        if len(text) > self.limit_bytes:
            raise self.fault(f"is larger than {self.limit_bytes / MIB:.0f} MiB, the most that is read of its kind")
        if _LONG_KEY.search(text):  # tomllib takes the square of its length in time and memory
            raise self.fault(f"is not valid here: a key has more than {KEY_PARTS} parts")
        try:
            document = tomllib.loads(text if "\n" in text else text.replace("\r", "\n"))  # an old Macintosh's lines
        except RecursionError as error:
            raise self.fault(f"is not valid TOML: it is nested deeper than {DEPTH} levels") from error
        except ValueError as error:  # tomllib lets a number of 5000 digits end in Python's own words
            advice = toml_advice(text, str(error))
            advice = f"; {advice}" if advice else ""
            raise self.fault(f"is not valid TOML: {printable_line(str(error), 200)}{advice}") from error
        if fault := bounds_fault(document, finite=False):
            raise self.fault(f"is not valid here: {fault}")
        return document

    def document(self, model: type[M], data: bytes | None = None) -> M:
        """Document of a strict model."""
        return self.validated(model, self.json(data))

    def validated(self, model: type[M], document: dict[str, Any]) -> M:
        """Document of a strict model, of JSON that is read already; lists do for tuples."""
        try:
            return model.model_validate_json(json.dumps(document, default=str))  # TOML has dates
        except (ValidationError, ValueError, RecursionError) as error:
            text = first_fault(error) if isinstance(error, ValidationError) else printable_line(str(error), 200)
            raise self.fault(f"is damaged: {text}") from error

    # Tables and pictures.

    def table(
        self, columns: Mapping[str, DataType | type[DataType]] | None = None, data: bytes | None = None
    ) -> DataFrame:
        """Parquet table; `columns` are the names and types that it must have, in any order; others are allowed.

        Raises
        ------
        DatasetError
            If it cannot be read, has too many rows, or lacks a column of its type.
        """
        import polars

        data = self.read() if data is None else data
        try:
            columns_found = polars.read_parquet_schema(io.BytesIO(data))
            if columns is not None and (fault := _columns_fault(columns_found, dict(columns))):
                raise self.fault(f"has {fault}")
            rows = polars.scan_parquet(io.BytesIO(data)).select(polars.len()).collect().item()
            if rows > TABLE_ROWS:
                raise self.fault(f"has {rows} rows: at most {TABLE_ROWS} are read")
            if rows * len(columns_found) > TABLE_VALUES:
                raise self.fault(
                    f"has {rows} rows of {len(columns_found)} columns: at most {TABLE_VALUES} values are read"
                )
            return polars.read_parquet(io.BytesIO(data))
        except (DatasetError, MemoryError):
            raise
        except (Exception, polars.exceptions.PanicException) as error:  # a decoder's faults are of many kinds
            reason = printable_line(str(error).partition("\n")[0], 200) or type(error).__name__
            raise self.fault(f"cannot be read: {reason}") from error

    def arrays(self, forms: Mapping[str, tuple[str, int]], data: bytes | None = None) -> dict[str, NDArray[Any]]:
        """Arrays of an uncompressed `.npz` file by name.

        Parameters
        ----------
        forms : mapping
            For each array its type as NumPy writes it, such as "<f4", and its number of axes. There must be no other.

        Raises
        ------
        DatasetError
            If it cannot be read, or holds other arrays, or an array of another type or number of axes.
        """
        content = self.read() if data is None else data
        with (
            self.decoding("cannot be read"),
            warnings.catch_warnings(),
            zipfile.ZipFile(io.BytesIO(content)) as archive,
        ):
            warnings.simplefilter("ignore")  # of strange texts in a header
            members = {entry.filename: entry for entry in archive.infolist()}
            if missing := [name for name in forms if f"{name}.npy" not in members]:
                raise self.fault(f"has no array '{missing[0]}'")
            if len(archive.infolist()) != len(forms):
                raise self.fault(f"holds more than {', '.join(forms)}")
            # what is stored as it is cannot be larger than the file
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in members.values()):
                raise self.fault("is compressed: only plain arrays are read")
            stored = {name: archive.read(f"{name}.npy") for name in forms}
            return {name: self._array(name, stored[name], *forms[name]) for name in forms}

    def _array(self, name: str, data: bytes, kind: str, axes: int) -> NDArray[Any]:
        """Array of the bytes of an `.npy` file; NumPy's reader would take memory for any shape that a header tells."""
        import numpy as np

        stream = io.BytesIO(data)
        if np.lib.format.read_magic(stream) != (1, 0):
            raise self.fault(f"has the array '{name}' in another version of NumPy's format")
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream)
        if (dtype.str, len(shape), is_fortran) != (kind, axes, False):
            raise self.fault(f"has the array '{name}' of type {dtype.str} and {len(shape)} axes, not {kind} and {axes}")
        values = data[stream.tell() :]
        if math.prod(shape) * dtype.itemsize != len(values):
            raise self.fault(f"has the array '{name}' with {len(values)} bytes for the shape {shape}"[:200])
        if dtype.kind == "b" and max(values, default=0) > 1:
            raise self.fault(f"has the array '{name}' with truth values that are neither 0 nor 1")
        return np.frombuffer(values, dtype).reshape(shape).copy()  # a view of bytes cannot be written

    def picture(self, formats: tuple[str, ...] = ("PNG", "JPEG"), data: bytes | None = None) -> Image:
        """Decoded picture; its declared size is looked at before a pixel is decoded.

        Raises
        ------
        DatasetError
            If it is none of the formats, damaged, or of more than 50 million pixels.
        """
        from PIL import Image, UnidentifiedImageError

        content = self.read() if data is None else data
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)
                with Image.open(io.BytesIO(content), formats=formats) as picture:
                    width, height = picture.size
                    if width * height > PICTURE_PIXELS:
                        raise self.fault(f"has {width} x {height} pixels: at most {PICTURE_PIXELS:.0e} are read")
                    picture.load()
                    return picture
        except DatasetError:
            raise
        except Image.DecompressionBombError as error:
            raise self.fault(f"has too many pixels: at most {PICTURE_PIXELS:.0e} are read") from error
        except UnidentifiedImageError as error:
            raise self.fault(f"is not a picture of the format {' or '.join(formats)}") from error
        except MemoryError:
            raise
        except Exception as error:  # a decoder's faults are of many kinds
            raise self.fault(f"is a damaged picture: {printable_line(str(error), 200)}") from error


def _without_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Object of its pairs: readers that take the first and the last of two would see two documents."""
    document = dict(pairs)
    if len(document) != len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"it has the key {next(key for key in keys if keys.count(key) > 1)!r} twice")
    return document


def bounds_fault(document: object, finite: bool = True) -> str:
    """First value of a document of dicts and lists that is beyond the bounds, with its place; empty if none is."""
    left: list[tuple[object, int, Any]] = [(document, 1, None)]
    while left:
        value, depth, place = left.pop()
        if fault := _value_fault(value, depth, finite):
            return f"{_place(place)} {fault}"
        if isinstance(value, dict):
            left += [(inner, depth + 1, (place, key)) for key, inner in value.items()]
        elif isinstance(value, list):
            left += [(inner, depth + 1, (place, number)) for number, inner in enumerate(value)]
    return ""


_LARGEST = 10**DIGITS
_SURROGATE = re.compile("[\ud800-\udfff]")


def _value_fault(value: object, depth: int, finite: bool) -> str:
    if isinstance(value, dict):
        if any(len(key) > NAME_LENGTH or _SURROGATE.search(key) for key in value):
            return f"has a key of more than {NAME_LENGTH} characters or with a lone surrogate"
        return f"is nested deeper than {DEPTH} levels" if depth > DEPTH else ""
    if isinstance(value, list):
        return f"is nested deeper than {DEPTH} levels" if depth > DEPTH else ""
    if isinstance(value, str):
        return "has a lone surrogate" if not value.isascii() and _SURROGATE.search(value) else ""
    if isinstance(value, int):
        return f"is a number of more than {DIGITS} digits" if abs(value) >= _LARGEST else ""
    if finite and isinstance(value, float) and not math.isfinite(value):
        return "is not a finite number"
    return ""


def _place(place: Any) -> str:
    """Path of a value as people write it, of the nested pairs (path of its parent, key), cut in the middle."""
    parts: list[str] = []
    while place is not None:
        place, key = cast("tuple[Any, str | int]", place)
        parts.append(str(key))
    parts.reverse()
    shown = parts if len(parts) <= 6 else [*parts[:3], "...", *parts[-2:]]
    return printable_line(".".join(shown), 120) or "its root"


def _columns_fault(found: Mapping[str, Any], wanted: dict[str, Any]) -> str:
    """First column that a table lacks or has of another type; empty if there is none."""
    if missing := [name for name in wanted if name not in found]:
        return f"no column '{missing[0]}'"
    wrong = next((name for name in wanted if found[name] != wanted[name]), None)
    return "" if wrong is None else f"a column '{wrong}' of type {found[wrong]}, not {wanted[wrong]}"


# Libraries that print.


@contextlib.contextmanager
def quiet_terminal() -> Iterator[None]:
    """Keep what a library prints about a damaged file off the terminal: it is said once, by the exception."""
    try:
        terminal = os.dup(2)
    except OSError:  # closed by whoever started us: nothing can be printed there
        yield
        return
    try:
        with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stdout(io.StringIO()):
            os.dup2(nowhere.fileno(), 2)
            yield
    finally:
        os.dup2(terminal, 2)
        os.close(terminal)
