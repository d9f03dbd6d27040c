"""Faults of raw codes that programs make between the converter and the file: bytes, bits, signs, and text in frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_JUMP = 0.5  # of the range, between two frames of one level: no noise does that
_FEWEST = 8  # pixels that jump: a cosmic ray or a blinking pixel has fewer
_COMPACT = 0.2  # of the frame: text is drawn at one place
_WRAPPED = 0.1  # of the range below the last code of 16 bits, in which negative numbers end


def code_fault(frames: NDArray[Any], bits: int) -> str:
    """Fault of the frames of one level, shape (n, h, w), as codes of so many bits; "" if there is none."""
    top, largest = (1 << bits) - 1, int(frames.max())
    if largest > top:
        return _beyond(frames, bits)
    return _jumps(frames, top) or _spread(frames[0], bits)


def _beyond(frames: NDArray[Any], bits: int) -> str:
    """Fault of codes above the last one of the bits."""
    top, largest = (1 << bits) - 1, int(frames.max())
    said = f"has the code {largest}, and {bits} bits end at {top}"
    codes = frames.astype(np.uint16)
    if int(codes.byteswap().max()) <= top:
        return f"{said}: its bytes are exchanged, high byte first; save it with the low byte first"
    if int(codes[codes > top].min()) > 65535 - _WRAPPED * top:
        return (
            f"{said}: numbers below 0 became 65535 and less, as black was subtracted; give the converter's codes, "
            "black included"
        )
    return f"{said}: write `bits` into capture.toml, and give codes that are not scaled to 16 bits"


def _jumps(frames: NDArray[Any], top: int) -> str:
    """Fault of pixels that jump over half of the range from frame to frame."""
    first = frames[0].astype(np.int32)
    apart = np.zeros(first.shape, bool)
    for frame in frames[1:]:
        apart |= np.abs(frame - first) > _JUMP * top
    count = int(apart.sum())
    if count < _FEWEST:
        return ""
    rows, columns = np.nonzero(apart)
    height, width = int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1
    said = f"has {count} pixels that change by more than half of the range from frame to frame"
    if height * width <= _COMPACT * apart.size:
        return (
            f"{said}, all within {width} x {height} pixels at ({columns.min()}, {rows.min()}): a date or a counter is "
            "written there; switch it off"
        )
    return (
        f"{said}: numbers below 0 became the largest codes, as black was subtracted, or those above the largest began "
        "anew; give the converter's codes, black included"
    )


def _spread(frame: NDArray[Any], bits: int) -> str:
    """Fault of codes that are more than one apart: rounding is a whole step then."""
    top = (1 << bits) - 1
    codes = np.flatnonzero(np.bincount(frame.ravel()))
    step = int(np.diff(codes).min()) if len(codes) > 2 else 1
    if step <= 1:
        return ""
    unused = step.bit_length() - 1
    stretched = top / (top >> unused)  # of a program that makes the last code the last one of more bits
    most = 1.0 if step > 3 else 0.5  # upper bits that are repeated below are up to 1 off
    shifted = any(np.abs(codes - s * np.rint(codes / s)).max() <= most for s in (1 << unused, stretched))
    if not shifted:
        return (
            f"has codes {step} or more apart, which a table or a digital gain spread: give the codes of the converter"
        )
    bytes_too = ", or whose bytes are exchanged" if step >= 256 else ""
    remedy = f"shift them right by {unused} bits, and write bits = {bits - unused} into capture.toml"
    remedy = f"{remedy}, or save them with the low byte first" if bytes_too else remedy
    return f"has codes {step} or more apart, which a program scaled{bytes_too}: {remedy}"
