"""Printed and shining pictures drawn at random: posters, notices, boxes, book spines, charts, screens, window views.

Each fills one surface. A print has albedos, shape (rows, columns, 4): bands R, G, B and the laser; row 0 is the lowest.
Screens and views are relative luminances with the same shape; who uses them scales them to radiances.
Text is marks: words as rows of strokes, which no camera here resolves.
"""

from __future__ import annotations

import numpy as np

from phibench.scenes.frames import Array, Vector
from phibench.scenes.shapes import Bitmap
from phibench.scenes.worlds.patterns import Shape2, fractal, mixed, shaded

_INK, _PAPER = np.array([0.04, 0.04, 0.05, 0.04]), np.array([0.78, 0.77, 0.72, 0.80])


def ink_colours(rng: np.random.Generator, count: int) -> Array:
    """Albedos of printed or dyed colours, shape (count, 4); dyes let red light of 650 nm pass more than 610 nm."""
    hue, strength, level = rng.random(count), rng.beta(1.0, 1.8, count), rng.uniform(0.04, 0.75, count)
    phase = 2.0 * np.pi * (hue[:, None] - np.array([0.0, 1.0, 2.0]) / 3.0)
    rgb = level[:, None] * (1.0 + strength[:, None] * 0.9 * np.cos(phase))
    return np.clip(np.c_[rgb, rgb[:, 0] * rng.uniform(1.0, 1.25, count)], 0.02, 0.85)


def dead_leaves(rng: np.random.Generator, shape: Shape2, colours: Array, count: int = 70) -> Array:
    """Opaque discs and boxes over each other, sizes as 1/r^2: the statistics of photographs."""
    rows, columns = shape
    values = np.broadcast_to(colours[0], (*shape, 4)).copy()
    size = 0.02 / np.sqrt(1.0 - rng.random(count) * (1.0 - (0.02 / 0.45) ** 2)) * max(shape)
    size[: count // 8] = rng.uniform(0.2, 0.45, count // 8) * max(shape)
    place, pick, round_ = rng.random((count, 2)) * shape, rng.integers(len(colours), size=count), rng.random(count)
    for k in np.argsort(-size):
        (v, u), r = place[k], size[k]
        low, high = max(int(v - r), 0), min(int(v + r) + 2, rows)
        left, right = max(int(u - r), 0), min(int(u + r) + 2, columns)
        y, x = np.arange(low, high)[:, None] - v, np.arange(left, right)[None] - u
        distance = np.hypot(y, x) if round_[k] < 0.5 else np.maximum(np.abs(y), np.abs(x) * (1.0 + 2.0 * round_[k]))
        inside = np.clip(r - distance, 0.0, 1.0)[..., None]
        values[low:high, left:right] += inside * (colours[pick[k]] - values[low:high, left:right])
    return shaded(values, 1.0 + 0.1 * fractal(rng, shape, 1.1))


def text(rng: np.random.Generator, values: Array, box: tuple[int, int, int, int], pitch: int, ink: Array) -> None:
    """Write lines of words into a box (low, high, left, right) of an image, `pitch` rows apart; edges ragged."""
    low, high, left, right = box
    if right - left < 3:
        return
    for base in range(high - pitch, low - 1, -pitch):
        if rng.random() < 0.12:
            continue
        end = left + int((right - left) * (1.0 if rng.random() < 0.7 else rng.uniform(0.2, 0.9)))
        marks = rng.uniform(0.35, 0.95, (max(pitch // 2, 1), end - left)) * (rng.random(end - left) > 0.17)
        line = values[base : base + len(marks), left:end]
        line += marks[: len(line), :, None] * (ink - line)


def poster(rng: np.random.Generator, shape: Shape2) -> Array:
    """Picture with a title and text, on a coloured ground."""
    rows, columns = shape
    colours = ink_colours(rng, 6)
    y = np.linspace(0.0, 1.0, rows)[:, None]
    values = mixed(colours, 0, 1, np.broadcast_to(y * rng.random(), shape))
    low, high = int(rows * rng.uniform(0.15, 0.4)), int(rows * rng.uniform(0.7, 0.95))
    edge = int(columns * rng.uniform(0.0, 0.12))
    values[low:high, edge : columns - edge] = photograph(rng, (high - low, columns - 2 * edge))
    ink = _INK if values[: max(low, 1)].mean() > 0.25 else _PAPER
    text(rng, values, (high + 1, rows - 2, columns // 10, 9 * columns // 10), max((rows - high) // 2, 3), ink)
    text(rng, values, (2, low - 1, columns // 10, 9 * columns // 10), 3, ink)
    return shaded(values, 1.0 + 0.02 * fractal(rng, shape, 1.0))


def photograph(rng: np.random.Generator, shape: Shape2) -> Array:
    """Photograph: a landscape, a portrait or things over each other; one in four is black and white."""
    kind = rng.integers(4)
    if kind < 2:
        values = landscape(rng, shape)
    elif kind == 2:
        values = portrait(rng, shape)
    else:
        values = dead_leaves(rng, shape, muted(ink_colours(rng, 9), rng.uniform(0.2, 0.6)))
    if rng.random() < 0.25:
        values = np.repeat(values[..., 1:2], 4, axis=-1) * 0.9
    return np.clip(values, 0.02, 0.9)


def muted(colours: Array, part: float) -> Array:
    """Colours with a part of their saturation, as of things in a photograph or of painted metal."""
    grey = colours[:, :3].mean(axis=1, keepdims=True)
    return np.asarray(grey + part * (colours - grey))


_GROUNDS = np.array(
    [
        [0.10, 0.14, 0.05, 0.09],  # meadow
        [0.05, 0.08, 0.04, 0.04],  # wood
        [0.33, 0.27, 0.17, 0.36],  # sand, stubble
        [0.21, 0.20, 0.20, 0.21],  # rock, streets
        [0.09, 0.15, 0.20, 0.08],  # water
        [0.60, 0.62, 0.66, 0.60],  # snow
    ]
)
_SKIES = np.array(
    [
        [[0.74, 0.75, 0.74, 0.74], [0.28, 0.42, 0.62, 0.27]],
        [[0.70, 0.70, 0.70, 0.70], [0.50, 0.52, 0.55, 0.50]],
        [[0.80, 0.55, 0.33, 0.82], [0.35, 0.36, 0.50, 0.36]],
    ]
)


def landscape(rng: np.random.Generator, shape: Shape2) -> Array:
    """Sky and grounds of fractal outline one behind the other, paler with distance."""
    rows, columns = shape
    y = np.linspace(0.0, 1.0, rows)[:, None]
    sky = _SKIES[rng.integers(len(_SKIES))]
    values = mixed(sky, 0, 1, np.clip(1.4 * y - 0.4 + 0.12 * fractal(rng, shape, 1.6), 0.0, 1.0))
    for k, top in enumerate(np.sort(rng.uniform(0.1, 0.65, 4))[::-1]):
        near = _GROUNDS[rng.integers(len(_GROUNDS))] * rng.uniform(0.7, 1.3)
        colour = near + 0.6 * (1.0 - k / 3.0) * (sky[0] - near)
        outline = top + 0.05 * fractal(rng, (1, columns), 1.1)
        ground = shaded(np.broadcast_to(colour, (*shape, 4)), 1.0 + (0.08 + 0.05 * k) * fractal(rng, shape, 1.0))
        values += np.clip((outline - y) * rows + 0.5, 0.0, 1.0)[..., None] * (ground - values)
    return values


def portrait(rng: np.random.Generator, shape: Shape2) -> Array:
    """Head and shoulders before a plain ground."""
    rows, columns = shape
    clothes, ground = muted(ink_colours(rng, 2), 0.6)
    skin = rng.uniform(0.12, 0.42) * np.array([1.45, 1.0, 0.72, 1.6])
    hair = rng.uniform(0.02, 0.2) * np.array([1.3, 1.0, 0.7, 1.4])
    y = (np.arange(rows)[:, None] + 0.5) / rows - 0.6
    x = ((np.arange(columns)[None] + 0.5) - (0.5 + rng.uniform(-0.1, 0.1)) * columns) / rows
    values = np.broadcast_to(ground, (*shape, 4)).copy()
    size = rng.uniform(0.8, 1.3)
    for colour, up, across, high, wide in (
        (hair, 0.06, 0.0, 0.24, 0.19),
        (clothes, -0.6, 0.0, 0.42, 0.42),
        (skin, -0.22, 0.0, 0.10, 0.07),
        (skin, 0.0, rng.uniform(-0.02, 0.02), 0.21, 0.15),
    ):
        distance = np.hypot((y / size - up) / high, (x / size - across) / wide)
        values += np.clip((1.0 - distance) * 0.15 * rows, 0.0, 1.0)[..., None] * (colour - values)
    return shaded(values, 1.0 + 0.25 * np.clip(2.0 * x, -0.6, 0.6) * rng.choice([-1, 1]) + 0.05 * fractal(rng, shape))


def corridor(rng: np.random.Generator, shape: Shape2) -> Array:
    """Dim corridor behind an open door, in perspective: floor, ceiling lamps, walls with doors, and an end."""
    rows, columns = shape
    v = (np.arange(rows)[:, None] + 0.5) / rows + np.zeros(shape)
    u = ((np.arange(columns)[None] + 0.5) / columns - 0.5) * columns / rows + np.zeros(shape)
    eye, at, high = float(rng.uniform(0.8, 1.5)), (float(rng.uniform(-0.1, 0.1)), 0.6), float(rng.uniform(1.1, 1.3))
    half, length = float(rng.uniform(0.35, 0.7)), float(rng.uniform(1.5, 6.0))
    du, dv = u - at[0], v - at[1]  # of the sight lines, per depth `eye`
    with np.errstate(divide="ignore"):
        depth = eye * np.stack(
            [
                np.where(dv < 0.0, at[1] / np.abs(dv), np.inf) - 1.0,
                np.where(dv > 0.0, (high - at[1]) / np.abs(dv), np.inf) - 1.0,
                np.where(du < 0.0, half + at[0], half - at[0]) / np.abs(du) - 1.0,
                np.full(shape, length / eye),
            ]
        )
    which, z = depth.argmin(axis=0), np.maximum(depth.min(axis=0), 0.0)
    up = at[1] + dv * (1.0 + z / eye)
    wall, floor = rng.uniform(0.35, 0.75) * np.array([1.0, 0.97, 0.9, 1.0]), muted(ink_colours(rng, 1), 0.3)[0] * 0.6
    leaf = muted(ink_colours(rng, 1), 0.5)[0]
    colours = np.array([floor, 0.75 * np.ones(4), wall, 0.9 * wall])
    values = colours[which]
    phase = float(rng.uniform(0.0, 1.0))
    door = (which == 2) & (np.mod(z + phase, 1.5) < 0.45) & (up < 0.95)
    door |= (which == 3) & (np.abs(u - at[0]) * (1.0 + z / eye) < 0.25) & (up < 0.95)
    values = np.where(door[..., None], leaf, values)
    light = 0.35 + 0.65 * np.cos(np.pi * (z / 1.2 + phase)) ** 2 * np.exp(-0.15 * z)
    return 0.5 * shaded(values, light * (1.0 + 0.03 * fractal(rng, shape, 1.0)))


def carton(rng: np.random.Generator, shape: Shape2) -> Array:
    """Side of a box: brown or white board with tape, flaps, a label and print; or a plastic crate with ribs."""
    rows, columns = shape
    kind = rng.random()
    brown = rng.uniform(0.2, 0.36) * np.array([1.35, 1.0, 0.62, 1.45])
    base = brown if kind < 0.6 else _PAPER * rng.uniform(0.6, 1.0) if kind < 0.72 else _plastic(rng)
    values = np.broadcast_to(base, (*shape, 4)).copy()
    if kind < 0.72:
        values *= 1.0 - 0.4 * (np.arange(rows)[:, None] == int(rows * rng.uniform(0.9, 0.97)))[..., None]  # flap
        tape = slice(int(0.45 * columns), max(int(0.55 * columns), int(0.45 * columns) + 1))
        low = 0 if rng.random() < 0.4 else int(0.7 * rows)
        values[low:, tape] += 0.6 * (brown * np.array([1.25, 1.15, 1.0, 1.25]) - values[low:, tape])
        if rng.random() < 0.6:
            ink = _INK if rng.random() < 0.7 else 0.5 * ink_colours(rng, 1)[0]
            low, left = int(rng.uniform(0.1, 0.6) * rows), int(rng.uniform(0.05, 0.5) * columns)
            text(rng, values, (low, low + max(rows // 4, 4), left, left + columns // 3), 4, ink)
    else:
        values[:: max(rows // 6, 2)] *= 0.55
        values[:, :: max(columns // 5, 2)] *= 0.75
        hole = values[int(0.7 * rows) : int(0.85 * rows), int(0.38 * columns) : int(0.62 * columns)]
        hole *= 0.25  # handle
    if rng.random() < 0.6:
        low, left = int(rng.uniform(0.05, 0.55) * rows), int(rng.uniform(0.05, 0.6) * columns)
        label = (low, low + max(int(0.3 * rows), 3), left, left + max(int(0.3 * columns), 4))
        values[label[0] : label[1], label[2] : label[3]] = _PAPER
        text(rng, values, (label[0] + 1, label[1], label[2] + 1, min(label[3] - 1, columns)), 3, _INK)
    edge = np.minimum(np.arange(rows), np.arange(rows)[::-1])[:, None] + np.zeros(shape)
    edge = np.minimum(edge, np.minimum(np.arange(columns), np.arange(columns)[::-1])[None])
    wear = 1.0 - 0.18 * (edge < 1) + 0.07 * fractal(rng, shape, 1.3) + 0.03 * fractal(rng, shape, 0.4)
    return np.clip(shaded(values, wear), 0.02, 0.88)


def _plastic(rng: np.random.Generator) -> Array:
    """Colour of a crate: grey, black, or a dyed plastic."""
    if rng.random() < 0.5:
        return np.full(4, float(rng.choice([0.04, 0.12, 0.3, 0.5])))
    return np.asarray(0.7 * muted(ink_colours(rng, 1), 0.5)[0])


def notice(rng: np.random.Generator, shape: Shape2) -> Array:
    """Printed page: headline, lines of text, perhaps a picture."""
    rows, columns = shape
    values = np.broadcast_to(_PAPER * rng.uniform(0.85, 1.1), (*shape, 4)).copy()
    text(rng, values, (rows - rows // 8, rows - 1, columns // 6, columns - columns // 6), 4, ink_colours(rng, 1)[0] / 2)
    middle = int(rows * rng.uniform(0.35, 0.8))
    if rng.random() < 0.5 and middle > rows // 3 and columns > 12:
        height, width = middle - rows // 4, columns - 2 * (columns // 6)
        values[rows // 4 : middle, columns // 6 : columns // 6 + width] = photograph(rng, (height, width))
        text(rng, values, (middle + 1, rows - rows // 7, columns // 8, columns - columns // 8), 3, _INK)
        text(rng, values, (2, rows // 4 - 1, columns // 8, columns - columns // 8), 3, _INK)
    else:
        text(rng, values, (2, rows - rows // 7, columns // 8, columns - columns // 8), 3, _INK)
    return shaded(values, 1.0 + 0.01 * fractal(rng, shape, 1.0))


def spines(rng: np.random.Generator, shape: Shape2) -> Array:
    """Row of book spines with bands and titles, dark above the lower ones."""
    rows, columns = shape
    colours = ink_colours(rng, 24)
    width = rng.integers(2, 7, columns)
    ends = np.cumsum(width)
    ends = np.r_[ends[ends < columns - 1], columns]
    values = np.full((*shape, 4), 0.03)
    top = np.clip(rng.normal(0.86, 0.09, len(ends)), 0.55, 1.0) * rows
    start = 0
    for k, end in enumerate(ends):
        colour, high = colours[rng.integers(24)], int(top[k])
        book = values[:high, start:end]
        book[:] = colour
        mark = int(rng.integers(1, max(high - 3, 2)))
        book[mark : mark + int(rng.integers(1, 5))] = colours[rng.integers(24)]
        book[:, -1] *= 0.45
        start = end
    return shaded(values, 1.0 + 0.08 * fractal(rng, shape, 0.7))


def whiteboard(rng: np.random.Generator, shape: Shape2) -> Array:
    """White board with smears, strokes of a few pens, boxes and lines of writing."""
    rows, columns = shape
    values = shaded(np.broadcast_to(_PAPER * 1.04, (*shape, 4)), 0.97 + 0.02 * fractal(rng, shape, 1.5))
    pens = np.array(
        [[0.05, 0.05, 0.06, 0.06], [0.55, 0.06, 0.07, 0.62], [0.06, 0.12, 0.45, 0.07], [0.05, 0.3, 0.1, 0.06]]
    )
    for _ in range(int(rng.integers(2, 6))):
        low, left = int(rng.integers(2, rows - 12)), int(rng.integers(2, columns - 14))
        high, right = min(low + int(rng.integers(8, 26)), rows - 2), min(left + int(rng.integers(10, 50)), columns - 2)
        text(rng, values, (low, high, left, right), 4, pens[rng.integers(4)])
    for _ in range(int(rng.integers(1, 6))):
        steps = np.cumsum(np.cumsum(rng.normal(0.0, 0.08, (90, 2)), axis=0), axis=0) + rng.random(2) * shape
        v, u = np.clip(steps.astype(int), 1, np.array(shape) - 2).T
        values[v, u] = pens[rng.integers(4)]
        values[v + 1, u] += 0.5 * (pens[0] - values[v + 1, u])
    return values


def chart(rng: np.random.Generator, shape: Shape2) -> Array:
    """Map, plan or diagram: fields with borders, lines and labels."""
    rows, columns = shape
    field, colours = fractal(rng, shape, 1.7), ink_colours(rng, 6)
    level = np.clip(np.floor(1.3 * field + 2.5), 0, 4).astype(int)
    pale = 0.5 * (colours + _PAPER)
    border = np.abs(np.mod(1.3 * field + 0.5, 1.0) - 0.5) < 0.08
    values = np.where(border[..., None], _INK * 3.0, pale[level])
    for _ in range(6):
        low, left = int(rng.integers(rows - 4)), int(rng.integers(columns - 8))
        text(rng, values, (low, low + 3, left, min(left + 12, columns)), 3, _INK)
    edge = max(rows // 30, 1)
    values[:edge], values[-edge:], values[:, :edge], values[:, -edge:] = (_PAPER,) * 4
    return values


def buttons(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Front of a device: plates, slots, dials, labels and rows of keys."""
    rows, columns = shape
    values = np.broadcast_to(colours[0], (*shape, 4)).copy()
    inks = ink_colours(rng, 8)
    for _ in range(int(rng.integers(5, 14))):
        low, left = int(rng.integers(1, rows - 3)), int(rng.integers(1, columns - 3))
        high, right = min(low + int(rng.integers(2, 9)), rows - 1), min(left + int(rng.integers(2, 14)), columns - 1)
        kind = rng.integers(3)
        if kind == 0:
            values[low:high, left:right] = inks[rng.integers(8)]
        elif kind == 1:
            values[low:high:2, left:right:2] = colours[-1]
        else:
            text(rng, values, (low, high, left, right), 3, _INK if colours[0, 1] > 0.2 else _PAPER)
    return shaded(values, 1.0 + 0.04 * fractal(rng, shape, 1.0))


def hazard(rng: np.random.Generator, shape: Shape2) -> Array:
    """Warning stripes, yellow and black or red and white, with wear."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    pair = np.array([[0.75, 0.48, 0.03, 0.78], [0.03, 0.03, 0.03, 0.03]])
    if rng.random() < 0.4:
        pair = np.array([[0.5, 0.04, 0.04, 0.6], [0.75, 0.75, 0.72, 0.76]])
    wave = np.mod((x + y) / 8.0, 1.0)
    share = np.clip(4.0 * (np.abs(wave - 0.5) - 0.25) + 0.5, 0.0, 1.0)
    return shaded(mixed(pair, 0, 1, share), 1.0 + 0.12 * fractal(rng, shape, 0.9))


def screen(rng: np.random.Generator, shape: Shape2) -> Array:
    """Screen in use, white at 1: windows with text, a dark terminal, or a picture."""
    rows, columns = shape
    kind = rng.integers(3)
    if kind == 0:
        return np.clip(1.2 * photograph(rng, shape), 0.01, 1.0)
    if kind == 1:
        values = np.full((*shape, 4), 0.02)
        glow = np.array([[0.2, 0.9, 0.3, 0.2], [0.8, 0.8, 0.8, 0.8], [0.9, 0.6, 0.15, 0.9]])[rng.integers(3)]
        text(rng, values, (1, rows - 1, 2, columns - 1), 3, glow)
        return values
    values = np.clip(photograph(rng, shape) * 0.5, 0.01, 1.0)
    for _ in range(int(rng.integers(1, 4))):
        low, left = int(rng.integers(rows // 2)), int(rng.integers(columns // 2))
        high, right = int(rng.integers(low + rows // 3, rows)), int(rng.integers(left + columns // 3, columns))
        values[low:high, left:right] = np.array([0.9, 0.9, 0.88, 0.9]) if rng.random() < 0.7 else 0.05
        text(rng, values, (low + 1, high - 3, left + 1, right - 1), 3, np.array([0.08, 0.08, 0.1, 0.08]))
        values[high - 2 : high, left:right] = ink_colours(rng, 1)[0]
    return values


def outdoors(rng: np.random.Generator, shape: Shape2) -> Array:
    """Lower part of a window's view, sky at 1: houses with windows, trees and ground, below the horizon's haze."""
    rows, columns = shape
    y = np.linspace(0.0, 1.0, rows)[:, None]
    green = np.array([[0.05, 0.09, 0.03, 0.04], [0.14, 0.19, 0.07, 0.1]])
    ground = mixed(green, 0, 1, 0.5 + 0.4 * fractal(rng, shape, 0.9))
    values = np.where((y > rng.uniform(0.5, 0.75))[..., None], np.array([0.75, 0.8, 0.85, 0.75]), ground)
    left = 0
    while left < columns:
        width, top = int(rng.integers(8, 26)), int(rows * rng.uniform(0.45, 0.95))
        if rng.random() < 0.6:
            wall = values[rows // 4 : top, left : left + width]
            wall[:] = 0.4 * ink_colours(rng, 1)[0] + 0.06
            wall[2::5, 2::4] = 0.03
            wall[3::5, 2::4] = 0.03
        left += width + int(rng.integers(0, 12))
    trees = fractal(rng, shape, 1.1) > 2.6 * (y - rng.uniform(0.2, 0.5)) + 0.2
    leaves = mixed(green, 0, 1, 0.4 + 0.5 * fractal(rng, shape, 0.5))
    return np.asarray(np.where(trees[..., None], leaves, values) * 0.6)


def radiance_bitmap(values: Array, size_m: Vector, white_w_m2_sr: Array) -> Bitmap:
    """Shining picture that fills a rectangle once; `white_w_m2_sr` (3,) is the radiance of 1 in each band."""
    rows, columns = values.shape[:2]
    scale = np.append(white_w_m2_sr, 0.0)  # the laser meets what reflects nothing
    return Bitmap(
        np.maximum(values, 0.0) * scale,
        (size_m[0] / columns, size_m[1] / rows),
        (-0.5 * size_m[0], -0.5 * size_m[1]),
        is_radiance=True,
    )
