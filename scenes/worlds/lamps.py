"""Lamps (ceiling panels, tubes, pendants, uplights), their places in a room, and band radiances by colour temperature.

Each band of the camera stands for an interval of wavelengths: R 590 to 680 nm, G 500 to 590 nm, B 410 to 500 nm. Light
of a colour temperature T has the band radiances of a black body at T, integrated over these intervals. Luminances use
the mean of CIE V(lambda) over each interval.
"""

from __future__ import annotations

import numpy as np

from phibench.scenes.frames import Array
from phibench.scenes.worlds.assembly import Assembly, Footprint, footprint_of
from phibench.scenes.worlds.floor_plan import Layout
from phibench.scenes.worlds.materials import MaterialSet, one_of

BANDS_NM = ((590.0, 680.0), (500.0, 590.0), (410.0, 500.0))
# 683 lm/W times the mean of V(lambda) over each band; tests/scenes/worlds/test_lamps.py derives them again.
EFFICACY_LM_W = (192.9, 560.1, 55.9)
_SECOND_RADIATION_NM_K = 1.438776877e7  # h c / k
_NODES, _WEIGHTS = 12, 2.0  # Gauss-Legendre: exact to 1e-9 for spectra this smooth
_LOWEST_M = 1.98  # nothing hangs lower: a tall figure ends below
_OFFSETS = (
    (0.0, 0.0),
    (0.5, 0.0),
    (-0.5, 0.0),
    (0.0, 0.5),
    (0.0, -0.5),
    (0.9, 0.9),
    (-0.9, -0.9),
    (0.9, -0.9),
    (-0.9, 0.9),
)


def black_body_bands(temperature_k: float) -> Array:
    """Radiance of a black body in the bands R, G, B, shape (3,), relative to the largest."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    limits = np.array(BANDS_NM)
    middle, half = limits.mean(axis=1, keepdims=True), 0.5 * np.diff(limits, axis=1)
    wavelength = middle + half * nodes
    radiance = wavelength**-5.0 / np.expm1(_SECOND_RADIATION_NM_K / (wavelength * temperature_k))
    total = (radiance * weights).sum(axis=1)
    return np.asarray(total / total.max())


def band_radiance(luminance_cd_m2: float, temperature_k: float) -> Array:
    """Radiance in the bands R, G, B, shape (3,), W/(m^2 sr), of a luminance and a colour temperature."""
    relative = black_body_bands(temperature_k)
    return np.asarray(relative * (luminance_cd_m2 / float(relative @ np.array(EFFICACY_LM_W))))


def ceiling_lamp(rng: np.random.Generator, materials: MaterialSet, kind: str, height_m: float) -> Assembly:
    """Lamp that hangs from the ceiling; its emitting part has the role "lamp"."""
    made, down = Assembly(), (0.0, 0.0, -1.0)
    white = materials.surface("white_plastic")
    if kind == "panels":
        size = ((0.6, 0.6), (1.2, 0.3), (1.2, 0.6))[rng.integers(3)]  # of a grid of ceiling panels
        low = height_m - float(rng.uniform(0.03, 0.08))
        made.box(
            "housing",
            (-size[0] / 2 - 0.02, size[0] / 2 + 0.02),
            (-size[1] / 2 - 0.02, size[1] / 2 + 0.02),
            (low, height_m - 0.003),
            white,
        )
        made.panel("light", (0.0, 0.0, low - 0.002), down, size, white, "lamp")
    elif kind == "tubes":
        drop = min(float(rng.uniform(0.08, 0.9)), height_m - _LOWEST_M - 0.15)  # on wires, above heads
        low, length = height_m - drop, float(rng.choice([1.2, 1.5]))  # T8 tubes
        case = one_of(rng, materials, ("white_plastic", "galvanised"))
        made.box("housing", (-length / 2 - 0.03, length / 2 + 0.03), (-0.07, 0.07), (low, low + 0.05), case)
        made.panel("light", (0.0, 0.0, low - 0.002), down, (length, 0.05), white, "lamp")
        for k, sign in enumerate((-1.0, 1.0)):
            made.post(f"wire_{k + 1}", sign * 0.4 * length, 0.0, (low + 0.05, height_m - 0.003), 0.006, case, 5)
    else:
        drop = min(float(rng.uniform(0.3, 1.2)), height_m - _LOWEST_M)
        low, radius = height_m - drop, float(rng.uniform(0.12, 0.24))
        shade = one_of(rng, materials, ("dark_plastic", "white_plastic", "paint_red", "paint_green", "copper", "steel"))
        made.post("shade", 0.0, 0.0, (low, low + min(0.16, drop - 0.02)), radius, shade, 16)
        if drop > 0.2:
            made.post("cord", 0.0, 0.0, (low + 0.16, height_m - 0.003), 0.008, materials.surface("dark_plastic"), 6)
        # lamps are rectangles: inside the shade's circle
        made.panel("light", (0.0, 0.0, low - 0.002), down, (radius, radius), white, "lamp")
    return made


def uplight(rng: np.random.Generator, materials: MaterialSet, height_m: float) -> Assembly:
    """Bowl at a wall that lights the ceiling."""
    made = Assembly()
    top = min(float(rng.uniform(1.75, 2.1)), height_m - 0.45)  # above eyes, and away from the ceiling that it lights
    half = float(rng.uniform(0.12, 0.25))
    case = one_of(rng, materials, ("white_lacquer", "steel", "porcelain", "copper"))
    made.box("bowl", (-half, half), (-0.16, -0.002), (top - 0.12, top), case)
    made.panel("light", (0.0, -0.081, top + 0.002), (0.0, 0.0, 1.0), (2.0 * half - 0.04, 0.12), case, "lamp")
    return made


def hang_lamps(layout: Layout, materials: MaterialSet, rng: np.random.Generator, most: int) -> None:
    """Place up to `most` lamps of the room's kind, at least one, where nothing stands or hangs before them."""
    kind = materials.properties.lamp_kind
    placed = _uplights(layout, materials, rng, most) if kind == "uplights" else 0
    if placed:
        return
    plan = layout.plan
    ratio = plan.length_m / plan.width_m
    across = max(round(float(np.sqrt(most * ratio))), 1)  # as near to a square grid as the room allows
    along = -(-most // across)
    regular = [
        ((i + 0.5) * plan.length_m / across, (j + 0.5) * plan.width_m / along)
        for i in range(across)
        for j in range(along)
    ]
    # for the first lamp alone, where the regular places are taken
    dense = [((i + 0.5) * plan.length_m / 24, (j + 0.5) * plan.width_m / 24) for i in range(24) for j in range(24)]
    turn = 0.0 if rng.random() < 0.7 else 0.5 * np.pi  # tubes run along the room, or across
    example = _drawn_kind(rng, kind)
    for x, y in (*regular, *dense):
        if placed >= (most if (x, y) in regular else 1):
            continue
        if kind == "mixed":
            example = _drawn_kind(rng, kind)
        made = ceiling_lamp(rng, materials, example, plan.height_m)
        for dx, dy in _OFFSETS:
            if _lamp_fits(layout, made, x + dx, y + dy, turn):
                layout.put("lamp", made, x + dx, y + dy, turn)
                placed += 1
                break


def _drawn_kind(rng: np.random.Generator, kind: str) -> str:
    return ("panels", "tubes", "pendants")[rng.integers(3)] if kind in ("mixed", "uplights") else kind


def _lamp_fits(layout: Layout, made: Assembly, x: float, y: float, yaw_rad: float) -> bool:
    place = footprint_of(made, x, y, yaw_rad)
    low, high = place.z
    # What is flat at the ceiling may be above the robot; half a metre below the light stays clear.
    axis_m = 0.0 if layout.plan.height_m - low < 0.1 else 0.45
    half = (place.half_m[0] + 0.05, place.half_m[1] + 0.05)
    return layout.is_free(Footprint(place.x, place.y, yaw_rad, half, (low - 0.4, high)), 0.0, axis_m)


def _uplights(layout: Layout, materials: MaterialSet, rng: np.random.Generator, most: int) -> int:
    placed = 0
    for _ in range(12 * most):  # most walls have something before them
        wall = layout.plan.walls[rng.integers(len(layout.plan.walls))]
        made = uplight(rng, materials, layout.plan.height_m)
        if wall.length_m < 1.0 or placed >= most:
            continue
        x, y = wall.place(float(rng.uniform(0.4, wall.length_m - 0.4)), 0.012)
        place = footprint_of(made, x, y, wall.yaw_rad)
        clear = Footprint(place.x, place.y, place.yaw_rad, place.half_m, (place.z[0], layout.plan.height_m - 0.001))
        if layout.is_free(clear, 0.05, 0.6, outline=False):
            layout.put("lamp", made, x, y, wall.yaw_rad, clear)
            placed += 1
    return placed
