r"""Reader of a descriptor file of EMVA 1288: a text that lists exposure times, light and pictures of one camera.

    v 3.0                        release of the standard
    n 12 640 480                 bits, width, height
    b 40000.0 120.0              bright: exposure time in ns, photons per pixel (of pairs; of larger stacks not taken)
    i images\b_000_snap_001.png   a picture, relative to the descriptor
    d 40000.0                    dark: exposure time in ns

`#` begins a comment; numbers may have a decimal comma. Each `b` is a level, each `d` a dark level. Pictures of one
filter are assumed, unless a `capture.toml` beside the descriptor says `format = "bayer-raw"`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from phibench.calibration.sensor_fit.capture_folder import (
    MANIFEST,
    Capture,
    CaptureError,
    CaptureNotes,
    FrameGroup,
    read_notes,
)
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile
from phibench.scenes.validation import printable_line

_REMEDY = "a descriptor of EMVA 1288 has lines `n bits width height`, `b ns photons`, `d ns` and `i picture`"
_ARGUMENTS = {"v": 1, "n": 3, "b": 2, "d": 1, "i": 1}
_NS = 1e-9


@dataclass(frozen=True)
class _Line:
    number: int
    key: str
    values: tuple[str, ...]


def open_descriptor(path: Path) -> Capture:
    """Capture of a descriptor file, its pictures not read.

    Raises
    ------
    CaptureError
        If a line is none of a descriptor, a level has one picture, or there are no dark or bright levels.
    """
    file = InputFile(path, _REMEDY, CaptureError, SETTINGS_BYTES)
    lines = list(_lines(file))
    formats = [line for line in lines if line.key == "n"]
    if len(formats) != 1:
        raise file.fault(f"has {len(formats)} lines `n`, and one is needed")
    bits, width, height = (_whole(file, formats[0], text) for text in formats[0].values)
    groups = list(_groups(file, lines))
    flats = tuple(group for group, bright in groups if bright)
    darks = [group for group, bright in groups if not bright]
    if not darks or not flats:
        raise file.fault(f"has {len(flats)} bright and {len(darks)} dark levels, and one or more of each are needed")
    main = max(darks, key=lambda group: len(group.files))
    others = tuple(group for group in darks if group is not main)
    notes = read_notes(path.parent / MANIFEST)
    kind = notes.format or "mono-raw"
    if kind not in ("mono-raw", "bayer-raw"):
        raise file.fault(f"lists raw pictures, and {MANIFEST} beside it says {kind}")
    known = {"bits": bits, "width_px": width, "height_px": height, "format": kind, "exposure_s": main.seconds or None}
    return Capture(
        folder=path.parent,
        notes=file.validated(CaptureNotes, {**notes.model_dump(exclude_none=True), **known}),
        kind=kind,
        size=(height, width),
        dark=main,
        flats=flats,
        dark_exposures=others if any(group.seconds != main.seconds for group in others) else (),
        _count=sum(len(group.files) for group, _ in groups),
    )


def _lines(file: InputFile) -> Iterator[_Line]:
    text = file.read().decode("utf-8-sig", errors="replace")  # comments may have any coding
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split(maxsplit=1)
        if not words:
            continue
        key, rest = words[0], words[1].strip() if len(words) == 2 else ""
        values = (rest,) if key == "i" and rest else tuple(rest.split())
        if _ARGUMENTS.get(key) != len(values):
            raise file.fault(f"line {number}: {printable_line(line.strip(), 80)!r} is no line of a descriptor")
        yield _Line(number, key, values)


def _groups(file: InputFile, lines: list[_Line]) -> Iterator[tuple[FrameGroup, bool]]:
    """Levels with their pictures, and whether they are bright."""
    heads = [k for k, line in enumerate(lines) if line.key in "bd"]
    first = heads[0] if heads else len(lines)
    if stray := [line for line in lines[:first] if line.key == "i"]:
        raise file.fault(f"line {stray[0].number}: a picture stands before the first level")
    for k, end in zip(heads, [*heads, len(lines)][1:], strict=True):
        head = lines[k]
        pictures = tuple(_picture(file, line) for line in lines[k + 1 : end] if line.key == "i")
        if len(pictures) < 2:
            raise file.fault(f"line {head.number}: a level with {len(pictures)} pictures, and noise needs two or more")
        seconds = _NS * _number(file, head, head.values[0])
        # stacks of many pictures are for the fixed pattern; reference sets state another light for them than they have
        photons = _number(file, head, head.values[1]) if head.key == "b" and len(pictures) == 2 else None
        yield FrameGroup(f"{file.path.name}, line {head.number}", pictures, seconds, photons), head.key == "b"


def _picture(file: InputFile, line: _Line) -> Path:
    parts = [word for word in re.split(r"[\\/]+", line.values[0]) if word != "."]
    if not all(parts) or ".." in parts or any(":" in word for word in parts):
        raise file.fault(f"line {line.number}: a picture's name is relative and below the descriptor")
    return file.path.parent.joinpath(*parts)


def _number(file: InputFile, line: _Line, text: str) -> float:
    if not re.fullmatch(r"\d{1,15}([.,]\d*)?([eE][+-]?\d{1,2})?", text):
        raise file.fault(f"line {line.number}: {printable_line(text, 40)!r} is no number of 0 or more")
    return float(text.replace(",", "."))


def _whole(file: InputFile, line: _Line, text: str) -> int:
    value = _number(file, line, text)
    if value != int(value):
        raise file.fault(f"line {line.number}: {printable_line(text, 40)!r} is no whole number")
    return int(value)
