"""Procedural patterns of surfaces: wood, tiles, bricks, carpet, paper and others, as small tileable images.

A pattern takes a random generator, a shape (rows, columns) and colours (k, 4), one row per colour with the albedos of
bands R, G, B and the laser. It returns albedos, shape (rows, columns, 4). All repeat without a seam.

Edges are one texel wide, because a texel is the mean over its area. Noise has power in every octave from the tile to
two texels and fades towards that end, so that nothing finer than the texels is claimed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from phibench.scenes.frames import Array

Shape2 = tuple[int, int]
Draw = Callable[[np.random.Generator, Shape2, Array], Array]
_FADE = 0.33  # cycles per texel where noise has fallen to 1/e: a third below Nyquist's 0.5


def fractal(
    rng: np.random.Generator, shape: Shape2, slope: float = 1.0, stretch: tuple[float, float] = (1.0, 1.0)
) -> Array:
    """Tileable noise, mean 0 and standard deviation 1, with the amplitude spectrum 1/f^slope.

    `stretch` (down, along) makes features longer in a direction.
    """
    rows, columns = shape
    down, along = np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None]
    frequency = np.hypot(down * stretch[0], along * stretch[1])
    frequency[0, 0] = np.inf
    gain = frequency**-slope * np.exp(-((down / _FADE) ** 4) - (along / _FADE) ** 4)
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * gain, shape)
    return np.asarray(noise / noise.std())


def mixed(colours: Array, first: int, second: int, part: Array) -> Array:
    """Colours between two, shape (..., 4), for parts (...) of the second."""
    return colours[first] + np.clip(part, 0.0, 1.0)[..., None] * (colours[second] - colours[first])


def shaded(values: Array, factor: Array) -> Array:
    """Albedos times a factor (rows, columns), all bands alike."""
    return values * np.maximum(factor, 0.0)[..., None]


def lattice(shape: Shape2) -> tuple[Array, Array]:
    """Places of the texels in the tile, y (rows, 1) and x (1, columns), each from 0 to 1."""
    rows, columns = shape
    return (np.arange(rows)[:, None] + 0.5) / rows, (np.arange(columns)[None] + 0.5) / columns


def band(place: Array, texels: int, low: float, high: float) -> Array:
    """Part of each texel between two places of the tile, for places of texel centres."""
    half = 0.5 / texels
    return np.clip((np.minimum(place + half, high) - np.maximum(place - half, low)) * texels, 0.0, 1.0)


def joints(place: Array, texels: int, count: int, width: float) -> Array:
    """Part of each texel that `count` equal joints cover; the first is centred on the tile's edge, width in tiles."""
    distance = np.abs(np.mod(place * count + 0.5, 1.0) - 0.5) / count
    return np.clip((0.5 * width - distance) * texels + 0.5, 0.0, 1.0) * min(1.0, width * texels)


def plain(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Paint or plaster: faint clouds, stains and grain."""
    clouds, grain = fractal(rng, shape, 1.6), fractal(rng, shape, 0.4)
    return shaded(mixed(colours, 0, 1, 0.3 + 0.3 * clouds), 1.0 + 0.03 * grain)


def concrete(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Concrete: stains at all scales, and pores."""
    stains, pores = fractal(rng, shape, 1.3), fractal(rng, shape, 0.6)
    # 2.2 sigma: 1.4 % are pores
    return shaded(mixed(colours, 0, 1, 0.4 + 0.35 * stains), 1.0 - 0.25 * (pores > 2.2) + 0.04 * pores)


def wood(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Wood whose grain runs along the columns: rings, fibres, and knots where the rings bend."""
    y, _ = lattice(shape)
    bend = fractal(rng, shape, 1.5, (1.0, 5.0))  # five times as long along the grain
    fibres = fractal(rng, shape, 0.5, (1.0, 14.0))  # fibres are longer still
    rings = np.sin(2.0 * np.pi * (rng.integers(2, 6) * y + 0.45 * bend))
    return shaded(mixed(colours, 0, 1, 0.4 + 0.3 * rings + 0.12 * bend), 1.0 + 0.06 * fibres)


def planks(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Floor boards along the columns, each with its own tint and cut, and dark joints."""
    rows, columns = shape
    # whole texels a board: no seam where the tile repeats
    count = int(rng.choice([d for d in (8, 12, 16) if rows % d == 0] or [1]))
    high = rows // count
    values = wood(rng, shape, colours)
    y, x = lattice(shape)
    dark = np.broadcast_to(joints(y, rows, count, 1.0 / rows), shape).copy()
    for board in range(count):
        place = slice(board * high, (board + 1) * high)
        values[place] = np.roll(values[place], int(rng.integers(columns)), axis=1)  # each board is cut from elsewhere
        cut = rng.random() + np.array([0.0, rng.uniform(0.4, 0.6)])  # two pieces a board
        ends = np.abs(np.mod(x - cut.reshape(2, 1) + 0.5, 1.0) - 0.5) * columns
        dark[place] = np.maximum(dark[place], np.clip(1.0 - ends, 0.0, 1.0).max(axis=0))
        tint = rng.uniform(0.78, 1.22, 2)  # one for each of them
        values[place] *= np.where(np.mod(x[0] - cut[0], 1.0) < cut[1] - cut[0], tint[0], tint[1]).reshape(1, -1, 1)
    return shaded(values, 1.0 - 0.6 * dark)


def parquet(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Basket weave: square blocks of strips, turned in turns."""
    rows, columns = shape
    blocks, strips = 4, 5
    grain = wood(rng, shape, colours)
    turned = np.swapaxes(wood(rng, (columns, rows), colours), 0, 1)
    y, x = lattice(shape)
    odd = (np.floor(y * blocks) + np.floor(x * blocks)) % 2 == 1
    tint = rng.uniform(0.8, 1.2, (2, blocks * strips, blocks))
    along = tint[0][(y * blocks * strips).astype(int), (x * blocks).astype(int)]
    across = tint[1].T[(y * blocks).astype(int), (x * blocks * strips).astype(int)]
    values = np.where(odd[..., None], turned, grain) * np.where(odd, across, along)[..., None]
    lines = np.where(
        odd, joints(x, columns, blocks * strips, 0.5 / columns), joints(y, rows, blocks * strips, 0.5 / rows)
    )
    return shaded(values, 1.0 - 0.7 * lines)


def tiles(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Square tiles with marbled faces and joints; a third of them as a checker or with mixed tints."""
    rows, columns = shape
    count = int(rng.choice([2, 4, 8]))
    y, x = lattice(shape)
    j, i = (y * count).astype(int), (x * count).astype(int)
    kind = rng.integers(3)
    pick = ((i + j) % 2 if kind == 0 else rng.random((count, count))[j, i] * (kind == 1)).astype(float)
    values = mixed(colours, 0, 1, pick + 0.12 * fractal(rng, shape, 1.2))
    values = shaded(values, rng.normal(1.0, 0.05, (count, count))[j, i] + 0.02 * fractal(rng, shape, 0.4))
    width = rng.uniform(0.8, 1.6)
    lines = np.maximum(joints(y, rows, count, width / rows), joints(x, columns, count, width / columns))
    return values + lines[..., None] * (colours[-1] - values)


def checker(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Checker of two colours with wear."""
    y, x = lattice(shape)
    count = 2 * int(rng.integers(1, 5))
    odd = (np.floor(y * count) + np.floor(x * count)) % 2
    return shaded(mixed(colours, 0, -1, odd), 1.0 + 0.05 * fractal(rng, shape, 0.9))


def bricks(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Running bond: each brick with its own tint, mortar between them."""
    rows, columns = shape
    courses, across = 12, 4  # bricks of 1 to 3, as long ones are laid
    y, x = lattice(shape)
    row = np.broadcast_to((y * courses).astype(int), shape)
    shifted = x + 0.5 * (row % 2) / across  # half a brick in every other course
    column = np.floor(shifted * across).astype(int) % across
    values = mixed(colours, 0, 1, rng.random((courses, across))[row, column] + 0.2 * fractal(rng, shape, 1.0))
    values = shaded(values, 1.0 + 0.08 * fractal(rng, shape, 0.5))
    mortar = np.maximum(joints(y, rows, courses, 1.4 / rows), joints(shifted, columns, across, 1.4 / columns))
    return values + (mortar * np.clip(0.9 + 0.1 * fractal(rng, shape, 0.5), 0.0, 1.0))[..., None] * (
        colours[-1] - values
    )


def motif(rng: np.random.Generator, shape: Shape2, repeats: int, slope: float, quarters: bool) -> Array:
    """Ornament that repeats `repeats` times each way, mean 0 and standard deviation 1.

    Mirrored left to right and dropped by half in every other column, as on printed paper; or with `quarters` mirrored
    both ways, as in a carpet. A shape that cannot be divided gets one ornament.
    """
    rows, columns = shape
    count = repeats if rows % repeats == columns % repeats == 0 else 1
    field = fractal(rng, (rows // count, columns // count), slope)
    field = field + field[:, ::-1]
    if quarters:
        field = field + field[::-1]
    if count % 2 or quarters:
        whole = np.tile(field, (count, count))
    else:
        whole = np.tile(np.concatenate([field, np.roll(field, len(field) // 2, axis=0)], axis=1), (count, count // 2))
    return np.asarray(whole / whole.std())


def carpet(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Pile with a woven ornament of three colours that repeats."""
    level = motif(rng, shape, int(rng.choice([4, 8])), 1.2, True)
    values = mixed(colours, 0, 1, 0.5 + 0.7 * level)
    values += 0.8 * np.clip(1.5 * level - 1.5, 0.0, 1.0)[..., None] * (colours[-1] - values)
    return shaded(values, 1.0 + 0.1 * fractal(rng, shape, 0.3) + 0.06 * fractal(rng, shape, 1.4))


def pile(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Plain carpet or felt: flecks, and paths where it is worn."""
    return shaded(mixed(colours, 0, 1, 0.5 + 0.3 * fractal(rng, shape, 0.3)), 1.0 + 0.08 * fractal(rng, shape, 1.3))


def wallpaper(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Stripes, or an ornament that repeats every few decimetres, on paper."""
    _, columns = shape
    _, x = lattice(shape)
    if rng.random() < 0.5:
        count = int(rng.integers(2, 7))
        stripe = np.broadcast_to(joints(x, columns, count, rng.uniform(0.2, 0.5) / count), shape)
    else:
        level = motif(rng, shape, int(rng.choice([4, 8])), 1.4, False)
        stripe = rng.uniform(0.4, 1.0) * np.clip(1.5 * level + 0.3, 0.0, 1.0)
    return shaded(mixed(colours, 0, 1, stripe), 1.0 + 0.02 * fractal(rng, shape, 0.8) + 0.02 * fractal(rng, shape, 1.4))


def plaid(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Woven stripes in both directions, and threads."""
    rows, columns = shape
    y, x = lattice(shape)
    values = np.broadcast_to(colours[0], (*shape, 4)).copy()
    for k in range(int(rng.integers(2, 5))):
        low, width = rng.uniform(0.0, 0.7), rng.uniform(0.04, 0.28)
        across = 0.5 * (band(y, rows, low, low + width) + band(x, columns, low, low + width))
        values += across[..., None] * (colours[1 + k % (len(colours) - 1)] - values)
    return shaded(values, 1.0 + 0.07 * fractal(rng, shape, 0.2) + 0.04 * fractal(rng, shape, 1.2))


def pegboard(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Board with a square grid of dark holes, four texels apart."""
    rows, columns = shape
    y, x = np.mgrid[:rows, :columns] % 4
    hole = np.clip(1.2 - np.hypot(y - 1.5, x - 1.5), 0.0, 1.0)  # round, with an edge of one texel
    values = mixed(colours, 0, 1, 0.5 + 0.2 * fractal(rng, shape, 1.2))
    return values + 0.9 * hole[..., None] * (colours[-1] - values)


def terrazzo(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Chips of several colours and sizes in a ground."""
    values = np.broadcast_to(colours[0], (*shape, 4)).copy()
    for k, slope in enumerate((0.6, 0.45, 0.3, 0.1)):  # higher ones would make blots instead of chips
        chips = np.clip(2.0 * (fractal(rng, shape, slope) - 1.2), 0.0, 1.0)
        values += chips[..., None] * (colours[1 + k % (len(colours) - 1)] - values)
    return shaded(values, 1.0 + 0.04 * fractal(rng, shape, 1.2))


def panels(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Ceiling panels with flecks, in a grid of metal strips."""
    rows, columns = shape
    y, x = lattice(shape)
    flecks = np.clip(fractal(rng, shape, 0.3) - 1.3, 0.0, 1.0)  # a tenth of the panel
    lines = np.maximum(joints(y, rows, 2, 2.0 / rows), joints(x, columns, 2, 2.0 / columns))
    tint = rng.normal(1.0, 0.02, (2, 2))[(y * 2).astype(int), (x * 2).astype(int)]
    values = shaded(mixed(colours, 0, 1, 0.9 * flecks), tint + 0.02 * fractal(rng, shape, 1.4))
    return values + 0.6 * lines[..., None] * (colours[-1] - values)


def metal(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Brushed or painted sheet: fine streaks along the columns, scratches and smudges."""
    streaks, smudges = fractal(rng, shape, 0.4, (1.0, 10.0)), fractal(rng, shape, 1.5)
    return shaded(mixed(colours, 0, 1, 0.35 + 0.3 * smudges), 1.0 + 0.05 * streaks)


def worn(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Paint or plastic in use: smudges, dust, and thin scratches in both directions."""
    dust, smudges = fractal(rng, shape, 0.5), fractal(rng, shape, 1.3)
    # 2 %
    scratches = [np.clip(fractal(rng, shape, 0.3, stretch) - 2.0, 0.0, 1.0) for stretch in ((1.0, 16.0), (16.0, 1.0))]
    values = mixed(colours, 0, 1, 0.3 + 0.25 * smudges)
    values += 0.4 * np.minimum(sum(scratches), 1.0)[..., None] * (colours[-1] - values)
    return shaded(values, 1.0 + 0.04 * dust)


def foliage(rng: np.random.Generator, shape: Shape2, colours: Array) -> Array:
    """Leaves on leaves: blotches of light and dark green with deep gaps."""
    blotches, gaps = fractal(rng, shape, 0.8), fractal(rng, shape, 0.7)
    return shaded(mixed(colours, 0, 1, 0.5 + 0.5 * blotches), 1.0 - 0.75 * np.clip(1.5 * gaps - 0.6, 0.0, 1.0))
