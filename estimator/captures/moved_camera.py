"""Shift between two pictures of one position: a camera that was pushed between laser on and laser off.

Both pictures lose what is wider than some pixels and are correlated over all shifts; the best one, by a parabola
through its neighbours, is the shift. The laser's spot is in one of them only, and counts as little as it has pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter

from phibench.estimator.interface import Image, Pair
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS

MOVED_PX = 0.3
"""Shift from which on a laser-off picture does not show what is behind the spot: edges leave a light of their own."""
_NARROW_PX, _WIDE_PX = 0.7, 4.0
_MOST_PX = 24  # larger ones are of another position, or no shift
_CLEAR = 0.5  # correlation that a shift must have, over that of the picture with itself
_RELIT = 0.05  # relative change of the room's light that is no drift of a lamp


def shift_px(one: Image, other: Image) -> tuple[float, float] | None:
    """Shift (u, v) of what both pictures show, pixels; None where they do not show the same.

    Parameters
    ----------
    one, other : pictures of one kind, as `interface.Pair` has them
    """
    (a, block), (b, _) = _detail(one), _detail(other)
    spectrum = fft.rfft2(b) * np.conj(fft.rfft2(a))
    correlation = fft.fftshift(fft.irfft2(spectrum, a.shape)) / max(
        math.sqrt(float(np.sum(a**2) * np.sum(b**2))), 1e-30
    )
    most, (v0, u0) = _MOST_PX // block, (a.shape[0] // 2, a.shape[1] // 2)
    part = correlation[v0 - most : v0 + most + 1, u0 - most : u0 + most + 1]
    v, u = np.unravel_index(int(np.argmax(part)), part.shape)
    if part[v, u] < _CLEAR or min(v, u) == 0 or v == part.shape[0] - 1 or u == part.shape[1] - 1:
        return None
    dv, du = (_vertex(part[v - 1 : v + 2, u]), _vertex(part[v, u - 1 : u + 2]))
    return block * (float(u) - most + du), block * (float(v) - most + dv)


def moved_between(pair: Pair) -> Iterator[tuple[str, float]]:
    """Positions whose laser-off picture is shifted, with the shift in pixels."""
    for position in POSITIONS:
        if f"{position}_off" not in pair.images:
            continue
        found = shift_px(pair.images[f"{position}_off"], pair.images[position])
        if found is not None and math.hypot(*found) >= MOVED_PX:
            yield position, math.hypot(*found)


def relit_between(pair: Pair) -> Iterator[tuple[str, float]]:
    """Positions whose laser-off picture is brighter or darker, with its codes over those with the laser on."""
    for position in POSITIONS:
        if f"{position}_off" in pair.images:
            on, off = (np.asarray(pair.images[name], float) for name in (position, f"{position}_off"))
            ratio = float(np.median(off) / max(np.median(on), 1e-9))
            if abs(ratio - 1.0) > _RELIT:
                yield position, ratio


def _detail(image: Image) -> tuple[Array, int]:
    """Luma without what is wide, and the side in pixels of its squares: 2 of a mosaic."""
    x = np.asarray(image, float)
    block = 1
    if x.ndim == 2:
        h, w = (size // 2 * 2 for size in x.shape)
        x, block = x[:h, :w].reshape(h // 2, 2, w // 2, 2).mean(axis=(1, 3)), 2
    elif x.shape[2] == 2:
        x = x[..., 0]
    else:
        x = x.mean(axis=2)
    fine = gaussian_filter(x, _NARROW_PX) - gaussian_filter(x, _WIDE_PX)
    limit = 4.0 * float(np.sqrt(np.mean(fine**2)))
    return np.clip(fine, -limit, limit), block


def _vertex(three: Array) -> float:
    """Place of the vertex of a parabola through three values at -1, 0, 1."""
    bend = three[0] - 2.0 * three[1] + three[2]
    return float(0.5 * (three[0] - three[2]) / bend) if bend < 0.0 else 0.0
