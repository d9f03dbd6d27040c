"""Mistakes that a pair's photographs show (files exchanged, camera moved, light changed, wrong stroke), as error texts.

Each mistake is tried on the pictures themselves: the spot is looked for as if it were mended. Only spots that are sure
prove one, so that noise is never explained.

A shift between laser on and off: both pictures lose what is wider than some pixels and are correlated over all shifts.
The laser's spot is in one of them only, and counts as little as it has pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter

from phibench.calibration.captures.pair_photos import PairPhotos, PositionPhotos
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.recipe.tables import MAX_STROKE_M, MIN_STROKE_M
from phibench.estimator.geometry.reflection import reflect
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import Answer, Image, Pair
from phibench.estimator.spots.detect import FARTHEST_M, NEAREST_M, PairDetection, detect
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS, Rig

_FACTORS = (0.1, 10.0, 0.3, 3.0, 0.01, 100.0, 0.001)  # of the stroke: units mistaken, and a few times too much
_SURE_SIGMAS, _EACH_SIGMAS = 12.0, 9.0  # of both spots together and of each: a fainter one may be noise
_OUTLINE_POINTS, _INSIDE = 24, 2e-3  # and the part of the mirror's size by which rays are traced inside its outline
_ALIKE = 0.8  # of the difference of two rooms, below which pictures are of one position


def missing_spot_error(pair: Pair, photos: PairPhotos, answer: Answer, of_outline: str = "") -> DatasetError:
    """Error of a pair in which a spot lacks or cannot be fitted; `of_outline` is what the mirror's outline contradicts.

    Spots are looked for where the rig lets a point of the room be seen: a wrong rig hides them.
    """
    if known := known_mistake_error(pair, photos):
        return known
    lacking = [p for p in POSITIONS if getattr(answer, p).uv_px is None]
    if not lacking:
        unfit = next(p for p in POSITIONS if getattr(answer, p).covariance_px2 is None)
        u, v = getattr(answer, unfit).uv_px
        return DatasetError(
            f"a light is seen in the picture {unfit} ({getattr(photos, unfit).on[0].path}) at ({u:.0f}, {v:.0f}) px, "
            "but no fit of it holds, it is too faint or beside another light; give more frames, less light of the room "
            "or more of the laser"
        )
    where = " and ".join(f"{p} ({getattr(photos, p).on[0].path})" for p in lacking)
    if of_outline:
        return DatasetError(
            f"no laser spot in the picture {where}: {getattr(answer, lacking[0]).status}, where this rig allows one; "
            f"{of_outline.removeprefix('doubtful: ')}"
        )
    advice = "" if pair.down_off is not None else "; give pictures with the laser off, too"
    return DatasetError(
        f"no laser spot in the picture {where}: {getattr(answer, lacking[0]).status}; look whether the laser is on and "
        f"its spot is seen in the mirror{_highest_seen(pair.rig)}, whether it is overexposed, whether down and up are "
        f"swapped, and whether the stroke is in metres{advice}"
    )


def _highest_seen(rig: Rig) -> str:
    """Say how high above the horizon a mirror of revolution shows anything, by the rays of its outline."""
    if not rig.mirror.has_rim:
        return ""
    outline = rig.outline_px(_OUTLINE_POINTS)
    middle = outline.mean(axis=0)
    leaving = reflect(rig.at(0.0), middle + (1.0 - _INSIDE) * (outline - middle)).direction_world
    highest = math.degrees(float(np.nanmax(np.arcsin(leaving[:, 2]))))
    return f", whose rim hides what is more than about {highest:.0f} degrees above the horizon"


def no_distance_error(pair: Pair, photos: PairPhotos, status: str) -> DatasetError:
    """Error of two spots that no point of the room gives."""
    return known_mistake_error(pair, photos) or DatasetError(
        f"the spots in {photos.down.on[0].path} and {photos.up.on[0].path} have no distance: their rays are {status}; "
        "look whether both show the same spot, with camera and mirror moved together"
    )


def known_mistake_error(pair: Pair, photos: PairPhotos) -> DatasetError | None:
    """Error of a mistake that the pictures themselves show, if they show one."""
    down, up = photos.down.on[0].path, photos.up.on[0].path
    if _offs_exchanged(pair):
        return DatasetError(
            f"the pictures with the laser off are exchanged: {photos.up.off[0].path} shows what {down} does; give it "
            "to --down-off, and the other to --up-off"
        )
    if moved := next(moved_positions(pair), None):
        return DatasetError(f"{moved_note(photos, *moved)}; take both again, with rig and camera at rest")
    if _both(detect(replace(pair, down=pair.up, up=pair.down, down_off=pair.up_off, up_off=pair.down_off))):
        return DatasetError(
            f"down and up are swapped: the spot moves the wrong way from {down} to {up}, but the right one if they "
            "change places; give them to --down and --up the other way round"
        )
    if (relit := next(relit_positions(pair), None)) is not None:
        return DatasetError(relit_note(photos, *relit))
    if fault := exchanged_colours_error(pair, photos):
        return fault
    for place in POSITIONS:
        if f"{place}_off" not in pair.images:
            continue
        turned: dict[str, Any] = {place: pair.images[f"{place}_off"], f"{place}_off": pair.images[place]}
        if _both(detect(replace(pair, **turned))):
            group: PositionPhotos = getattr(photos, place)
            return DatasetError(
                f"laser on and off are exchanged at the position {place}: the spot is in {group.off[0].path}; give "
                f"it to --{place}, and {group.on[0].path} to --{place}-off"
            )
    if pair.down_off is not None and pair.up_off is not None:
        other = replace(pair, down=pair.down_off, up=pair.up_off, down_off=pair.down, up_off=pair.up)
        if _both(detect(other)):
            return DatasetError(
                f"laser on and off are exchanged: the spot is in {photos.down.off[0].path} and "
                f"{photos.up.off[0].path}; give these to --down and --up, the others to --down-off and --up-off"
            )
        crossed = replace(pair, down=pair.up_off, up=pair.down_off, down_off=pair.up, up_off=pair.down)
        if _both(detect(crossed)):
            return DatasetError(
                f"laser on and off are exchanged, and down and up, too: give {photos.up.off[0].path} to --down, "
                f"{photos.down.off[0].path} to --up, {up} to --down-off and {down} to --up-off"
            )
    return next(_strokes_faults(pair), None)


def exchanged_colours_error(pair: Pair, photos: PairPhotos) -> DatasetError | None:
    """Error of pictures whose spots are blue: programs that count B, G, R wrote them as R, G, B."""
    if any(image.ndim != 3 or image.shape[2] != 3 for image in pair.images.values()):
        return None
    turned: dict[str, Any] = {name: image[..., ::-1] for name, image in pair.images.items()}
    other = detect(replace(pair, **turned))
    if not _both(other) or _evidence(other) < _MORE_EVIDENCE * _evidence(detect(pair)):
        return None
    return DatasetError(
        f"red and blue are exchanged: the spots in {photos.down.on[0].path} and {photos.up.on[0].path} are blue; "
        "OpenCV counts B, G, R: turn the colours around before the pictures are saved"
    )


def _evidence(found: PairDetection) -> float:
    """Significance of both spots together."""
    return math.hypot(*(spot.significance for spot in (found.down, found.up) if spot is not None), 0.0)


def moved_note(photos: PairPhotos, position: str, shift_px: float) -> str:
    """Sentence on a camera that moved between laser on and off."""
    group: PositionPhotos = getattr(photos, position)
    files = f"from {group.on[0].path} to {group.off[0].path}"
    return f"the camera moved between laser on and off, by {shift_px:.1f} px {files}"


def _offs_exchanged(pair: Pair) -> bool:
    """True where each laser-off picture is far more alike to the other position's picture."""
    if pair.down_off is None or pair.up_off is None:
        return False
    images = {name: np.asarray(image, float) for name, image in pair.images.items()}

    def off(a: str, b: str) -> float:
        return float(np.sqrt(np.mean((images[a] - images[b]) ** 2)))

    return all(off(a, f"{b}_off") < _ALIKE * off(a, f"{a}_off") for a, b in (POSITIONS, POSITIONS[::-1]))


def _strokes_faults(pair: Pair) -> Iterator[DatasetError]:
    """Errors of a stroke with which both spots are no point of a room, but are with another."""
    for stroke in (factor * pair.stroke_m for factor in _FACTORS):
        if not MIN_STROKE_M <= stroke <= MAX_STROKE_M:
            continue
        detection = detect(replace(pair, stroke_m=stroke))
        if detection.down is None or detection.up is None or not _both(detection):
            continue
        uv = np.array(detection.down.uv_px), np.array(detection.up.uv_px)
        per_m = float(depth_exact(pair.rig, stroke, *uv).depth_m) / stroke  # D grows with the stroke
        if not per_m > 0.0 or NEAREST_M <= per_m * pair.stroke_m <= FARTHEST_M:
            continue  # the stroke is possible: something else is wrong
        yield DatasetError(
            f"the stroke contradicts the pictures: with {pair.stroke_m:.4g} m no point of a room, {NEAREST_M:g} to "
            f"{FARTHEST_M:g} m away, is seen at both spots; a stroke of {NEAREST_M / per_m:.2g} to "
            f"{FARTHEST_M / per_m:.2g} m is possible; give --stroke-m in metres"
        )


_MORE_EVIDENCE = 1.5  # of blue spots over red ones, from which on the colours are exchanged


def _both(found: PairDetection) -> bool:
    """True where both spots are sure."""
    z = [spot.significance for spot in (found.down, found.up) if spot is not None]
    return len(z) == len(POSITIONS) and min(z) >= _EACH_SIGMAS and math.hypot(*z) >= math.sqrt(2.0) * _SURE_SIGMAS


# -- between laser on and off -----------------------------------------------------------------------------------------

MOVED_PX = 0.3
"""Shift from which on a laser-off picture does not show what is behind the spot: edges leave a light of their own."""
_NARROW_PX, _WIDE_PX = 0.7, 4.0  # a difference of Gaussians: edges stay, noise and shading go
_MOST_PX = 128  # larger ones leave too little that both pictures show
_PARTS, _FEWEST_PARTS = 5, 4  # of a picture's sides, and parts of it that must show a shift
_CLEAR = 0.5  # correlation that a shift must have, over that of the picture with itself
_RELIT = 0.05  # relative change of the room's light that is no drift of a lamp
_BLACK_BESIDE = 10.0  # of codes: the room is hardly seen with the laser on


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
    v0, u0 = a.shape[0] // 2, a.shape[1] // 2
    most = min(_MOST_PX // block, v0 - 1, u0 - 1)
    around = correlation[v0 - most : v0 + most + 1, u0 - most : u0 + most + 1]
    v, u = np.unravel_index(int(np.argmax(around)), around.shape)
    if around[v, u] < _CLEAR or min(v, u) == 0 or v == around.shape[0] - 1 or u == around.shape[1] - 1:
        return None
    dv, du = (_vertex(around[v - 1 : v + 2, u]), _vertex(around[v, u - 1 : u + 2]))
    return block * (float(u) - most + du), block * (float(v) - most + dv)


def moved_positions(pair: Pair) -> Iterator[tuple[str, float]]:
    """Positions whose laser-off picture is shifted, with the shift in pixels."""
    for position in POSITIONS:
        if f"{position}_off" not in pair.images:
            continue
        off, on = pair.images[f"{position}_off"], pair.images[position]
        shift = shift_px(off, on)
        way = 0.0 if shift is None else math.hypot(*shift)
        if way >= MOVED_PX or (way := _turned_px(off, on)) >= MOVED_PX:
            yield position, way


def _turned_px(one: Image, other: Image) -> float:
    """Way of parts of two pictures, pixels, of which a turn hides the mean: their upper quartile; 0 of few parts."""
    height, width = (size // _PARTS // 2 * 2 for size in one.shape[:2])
    ways = []
    for row, column in np.ndindex(_PARTS, _PARTS):
        part = np.s_[row * height : (row + 1) * height, column * width : (column + 1) * width]
        if (shift := shift_px(one[part], other[part])) is not None:
            ways.append(math.hypot(*shift))
    return float(np.quantile(ways, 0.75)) if len(ways) >= _FEWEST_PARTS else 0.0


def relit_positions(pair: Pair, least: float = _RELIT) -> Iterator[tuple[str, float]]:
    """Positions whose laser-off picture is brighter or darker, with its codes over those with the laser on."""
    for position in POSITIONS:
        if (ratio := light_ratio(pair, position)) is not None and abs(ratio - 1.0) > least:
            yield position, ratio


def light_ratio(pair: Pair, position: str) -> float | None:
    """Median code with the laser off over that with the laser on; None without such a picture."""
    if f"{position}_off" not in pair.images:
        return None
    on, off = (np.asarray(pair.images[name], float) for name in (position, f"{position}_off"))
    return float(np.median(off) / max(np.median(on), 1e-9))


def relit_note(photos: PairPhotos, position: str, ratio: float) -> str:
    """Sentence on light that changed between laser on and off."""
    group: PositionPhotos = getattr(photos, position)
    if ratio > _BLACK_BESIDE:
        return (
            f"{group.on[0].path} is black beside {group.off[0].path}: a difference of both, or another exposure; give "
            "pictures as the camera took them, with one exposure"
        )
    return (
        f"the light changed between laser on and off: {group.off[0].path} has {ratio:.2f} times "
        "the codes of the picture with the laser on; fix exposure and white balance, and leave the lamps alone"
    )


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
