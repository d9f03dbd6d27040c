"""Adaptive sampling of the film: which pixels are cut into cells, samples of each cell, and cells that lamps cover.

1. Each pixel gets one sample that decides and counts for nothing (a scout). Where the contrast of the scouts around is
   low, one sample a of the whole pixel does. Other pixels are cut into cells, each with two samples a and b.
2. Cells in the mirror whose surroundings are not even are sampled again on n x n strata. By the samples b around a cell
   n is chosen for its half a, and by a for b.
3. Where the noise that is then found is above its budget, the cells around are sampled again, more finely.

**Bias.** A mean is biased if its own samples decide whether they are kept: what all of them miss would stay missed. In
1 and 2 no sample decides on itself. Scouts are dropped. Half a has n(b) strata, with n fixed before a is drawn, and any
number of strata has the right expectation; so has a, and b likewise, exactly. 3 judges by the halves themselves. It is
left with the few pixels in which 1 and 2 saw nothing; all cells around are replaced, whatever they had met.

**Noise.** Half the difference of a cell's halves, squared, is the variance of their mean. A whole pixel's sample and
the mean s of its n scouts differ by (a - s)^2, in the mean 1 + 1/n times the variance of a. An edge through a cell
leaves spread / (2 n^3), with `spread` the variance of single samples: n strata are crossed, each counts for 1/n^2.
Once cells are refined, the larger of the two is taken: stopping by a cell's own estimate alone would flatter it.

An edge of contrast c that cuts cells at random leaves single samples a variance of c^2 / 6. It is seen in the 3 x 3
cells around, which are cut in one of three columns: c^2 / 18 for each. A gradient g leaves g^2 / 12, and 3 x 3 cells
see twice g: c^2 / 18 is nearly three times as much, and strata gain more there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phibench.render.room.film_cells import (
    NEAR_PX,
    Box,
    Cells,
    allowed_of_sum,
    any_cell,
    bounds,
    cell_plane,
    contrast,
    cut_in,
    extreme,
    fold,
    grown,
    inner,
    mean_of_nine,
    means_of_cells,
    moments_of,
    moved_box,
    of_cells,
    of_rank,
    reach_px,
    share_of_cell,
    strips_of,
    sum_of_colours,
    taps_of_pixels,
)
from phibench.render.room.noise_budget import allowed_per_s2, is_full, variance_excess
from phibench.render.room.subpixel_grid import RIM_PX, CellSampler, Crop, Stack

_MOST_SIDE = 128  # strata along a cell
_GROWTH = 8.0  # of the strata along a side, in one round
_LAMP_SIDE = 2  # strata at first where a lamp's part is computed
_SMALL = 0.3  # a cell below this part of its allowance is not what keeps a pixel above its budget: 0.3 and `_AIM` are 1
_SURELY = 2.0  # by few samples a pixel at the edge of a lamp may look full that is not
_AIM = 0.7  # of the allowed variance
_EVEN = 1.0 / 8.0  # of the allowed variance: a whole pixel's sample, that counts at its centre, moves no edge then
_OUTSIDE = 16.0  # beyond the mirror, where no spot is located, it may be so many times as much
_CUT = 1.0 / 18.0  # variance of single samples over their squared contrast
_TRUE = 0.4  # of the variance that contrast foretells: strata are even, and most edges are short
_SCOUT, _FIRST, _AGAIN = 0, 1, 1000  # streams: two for each turn from each of the last two on; turns are fewer than 500


def render_refined(film: CellSampler, window: Crop, rounds: int, budget: float) -> tuple[Stack, Stack]:
    """Pixels of a window and their variance, shape (3, height, width) each; without rounds those of the first pass."""
    cells = first_pass(film, window, budget)
    height, width = window[3], window[2]
    box = bounds(inner(cells.grid, cells.mirrored)) if rounds else None
    if box is not None:
        _second_pass(film, cells, box, budget)
    pixels = np.empty((2, 3, height, width), dtype=np.float32)
    fold(cells, pixels, slice(0, height), slice(0, width))
    for turn in range(1, rounds + 1):
        if box is None:
            break
        box = refine(film, cells, pixels, box, budget, turn)
    return pixels[0], pixels[1]


# Scouts, and the first samples.


def first_pass(film: CellSampler, window: Crop, budget: float) -> Cells:
    """Scouts of all pixels, then a sample of each pixel or two of its cells."""
    grid, squares = film.grid, film.grid.squares(window)
    light, mirrored, met = _scouted(film, squares)
    total = sum_of_colours(light)
    allowed = allowed_of_sum(mean_of_nine(total.mean(axis=0)), grid, budget)
    share = float(np.sum(taps_of_pixels(grid) ** 2) ** 2)
    high, low = total.max(axis=0), total.min(axis=0)
    around = extreme(np.maximum, high, 1) - extreme(np.minimum, low, 1)
    uneven = (share * _CUT) * np.square(around) / allowed
    inside = grown(mirrored, NEAR_PX)
    full = ~grown(~_all_full(light), reach_px(grid))
    cut = uneven > np.where(inside, np.float32(_EVEN), np.float32(_EVEN * _OUTSIDE))
    own = (slice(RIM_PX, -RIM_PX), slice(RIM_PX, -RIM_PX))
    cells = Cells.uncut(grid, squares[own], mirrored[own].copy(), full[own], (high - low)[own])
    cells.met[:] = met[own]
    new, matters = cut[own], (inside & ~full)[own]
    while new.any():
        _cut(film, cells, *np.nonzero(new))
        new = matters & grown(cells.met >= 0, reach_px(grid)) & (cells.rank < 0)
    if (whole := cells.rank < 0).any():  # none where every pixel is cut
        _sample_whole(film, cells, whole, light[:, :, *own])
    _find_lamps(film, cells)
    return cells


def _scouted(film: CellSampler, squares: NDArray[np.uint32]) -> tuple[Stack, NDArray[np.bool_], NDArray[np.int32]]:
    """Light of scouts, shape (3, n, rows, columns); pixels that see the mirror; brightest lamp met, -1 for none."""
    numbers = film.grid.scouts_of(squares.ravel())
    shape = (len(numbers), *squares.shape)
    found = film.sample_once(numbers.ravel(), _SCOUT, film.grid.scouts)
    met = found.lamp.reshape(shape).max(axis=0)
    return found.electrons_per_s.reshape(3, *shape), np.asarray(found.mirrored.reshape(shape).any(axis=0)), met


def _sample_whole(film: CellSampler, cells: Cells, chosen: NDArray[np.bool_], scouts: Stack) -> None:
    """A sample of whole pixels, which a mask chooses; its variance by their scouts, shape (3, n, rows, columns)."""
    found, n = film.sample_once(cells.squares[chosen], _FIRST, 1), scouts.shape[1]
    for k, value in enumerate(found.electrons_per_s):
        expected = scouts[k, 0] if n == 1 else scouts[k].mean(axis=0)
        cells.whole[0][k][chosen] = value
        cells.whole[1][k][chosen] = np.float32(n / (n + 1)) * np.square(value - expected[chosen])
    cells.mirrored[chosen] |= found.mirrored


def _cut(film: CellSampler, cells: Cells, row: NDArray[np.intp], column: NDArray[np.intp]) -> None:
    """Cut pixels into cells with two samples."""
    own = cells.cut(row, column)
    numbers = cells.numbers[own]
    for half in (0, 1):
        found = film.sample_once(numbers.ravel(), _FIRST + half)
        cells.halves[half][:, own] = found.electrons_per_s.reshape(3, *numbers.shape)
        cells.mirrored[row, column] |= any_cell(found.mirrored.reshape(numbers.shape))
        met = np.maximum.reduce(found.lamp.reshape(numbers.shape).T.copy())
        cells.met[row, column] = np.maximum(cells.met[row, column], met)


def _find_lamps(film: CellSampler, cells: Cells) -> None:
    """Find the brightest lamp that samples within the blur's reach met, for each cell that is cut.

    None either where its part cannot be computed, or where a sample in reach met the outline of that lamp but not the
    lamp. What a hidden lamp would cover
    is noise, of few and large errors: the halves of a cell agree by chance on a wrong mean.
    """
    if film.lamps is None or not cells.count:
        return
    lamp = extreme(np.maximum, cells.met, reach_px(cells.grid))
    lamp[cells.rank < 0] = -1
    near = np.flatnonzero(lamp >= 0)
    if not near.size:
        return
    rank = cells.rank.ravel()[near]
    numbers = cells.numbers[rank]
    which = np.repeat(lamp.ravel()[near], numbers.shape[1])
    hidden = np.zeros(lamp.shape, dtype=bool)
    behind = (film.hidden(numbers.ravel(), _FIRST + half, which) for half in (0, 1))
    hidden.ravel()[near] = any_cell(np.logical_or(*behind).reshape(numbers.shape))
    seen = np.repeat(~grown(hidden, reach_px(cells.grid)).ravel()[near], numbers.shape[1])
    if not seen.any():
        return
    cover = film.cover(numbers.ravel()[seen], which[seen])
    known = cover.light.max(axis=0) > 0.0
    places = (rank[:, None] * numbers.shape[1] + np.arange(numbers.shape[1])).ravel()[seen][known]
    cells.lamps.ravel()[places] = np.arange(len(places))
    cells.cover = cover.of(known)


# Second pass: strata of each half by the samples of the other.


def _second_pass(film: CellSampler, cells: Cells, box: Box, budget: float) -> None:
    """Sample cells in the mirror again; `box` are rows and columns of the window that show it."""
    m = cells.grid.margin_px
    part = (slice(box[0].start, box[0].stop + 2 * m), slice(box[1].start, box[1].stop + 2 * m))
    inside = grown(cells.mirrored[part], 1)
    n = cells.grid.cells
    seen = np.repeat(np.repeat(cells.contrast[part], n, axis=0), n, axis=1)
    wanted = [_strata(cells, half, part, inside, seen, budget) for half in (1, 0)]
    computed = (cells.lamps >= 0) & ((wanted[0] > 1) | (wanted[1] > 1))
    for half, side in enumerate(wanted):
        side[computed] = _LAMP_SIDE
        chosen = np.flatnonzero(side > 1)
        _sample_half(film, cells, half, chosen, side.ravel()[chosen], _FIRST + 2 + half)
    _without_hidden_lamps(film, cells, 1)


def _strata(
    cells: Cells, half: int, part: Box, inside: NDArray[np.bool_], seen: Stack, budget: float
) -> NDArray[np.int32]:
    """Strata along a side that cells need by one half, shape (N, k); 1 where `inside`, a part of pixels, is not.

    `seen` is the contrast of the scouts around each cell of the part.
    """
    grid, n, m = cells.grid, cells.grid.cells, cells.grid.margin_px
    row, column, rank = cut_in(cells, part)
    own = sum_of_colours(cells.halves[half])[None]
    plane = cell_plane(grid, sum_of_colours(cells.whole[0][:, *part])[None], row, column, of_rank(own, rank))[0]
    variance: Stack = np.float32(0.5 * _TRUE * _CUT) * np.square(np.maximum(contrast(plane), seen))
    allowed = allowed_of_sum(mean_of_nine(means_of_cells(plane, n)), grid, budget)
    tight = extreme(np.minimum, allowed, 1)
    near, middle = np.zeros(allowed.shape, dtype=np.float32), (slice(m, -m), slice(m, -m))
    near[middle] = grid.pixels(variance[None], power=2)[0] / allowed[middle]
    near[cells.full[part]] = 0.0
    near = extreme(np.maximum, near, reach_px(grid))
    here = inside[row, column] & (near[row, column] > _AIM)
    row, column, rank = row[here], column[here], rank[here]
    strata = np.ones(cells.numbers.shape, dtype=np.int32)
    ratio = share_of_cell(grid) * of_cells(grid, variance, row, column) / tight[row, column][:, None]
    wanted = _next_side(np.cbrt(np.minimum(ratio, near[row, column][:, None]) / _AIM))
    strata[rank] = np.where(cells.lamps[rank] >= 0, _LAMP_SIDE, wanted)
    return strata


def _next_side(wanted: Stack) -> NDArray[np.int32]:
    """Numbers of strata along a side that are at least what is wanted."""
    return np.asarray(np.ceil(np.clip(wanted, 1.0, _MOST_SIDE)).astype(np.int32))


def _sample_half(
    film: CellSampler, cells: Cells, half: int, chosen: NDArray[np.intp], side: NDArray[np.int32], stream: int
) -> None:
    """Replace one half of some cells (flat indices) by new samples."""
    if not chosen.size:
        return
    numbers, lamps = cells.numbers.ravel()[chosen], cells.lamps.ravel()[chosen]
    values, edges = cells.halves[half].reshape(3, -1), cells.edges.reshape(3, -1)
    for part, known in ((lamps < 0, False), (lamps >= 0, True)):
        if part.any():
            cover = cells.cover.of(lamps[part]) if known and cells.cover else None
            found = film.sample(numbers[part], side[part], stream, cover)
            least = 0.25 * found.spread / side[part].astype(np.float32) ** 3
            for k, where in ((k, chosen[part]) for k in range(3)):
                values[k][where] = found.electrons_per_s[k]
                edges[k][where] = least[k] if half == 0 else edges[k][where] + least[k]
    cells.side[half].ravel()[chosen] = side


def _without_hidden_lamps(film: CellSampler, cells: Cells, turn: int) -> NDArray[np.bool_]:
    """Sample cells again by chance around those whose mean is negative: no cell that sees its lamp has such a mean.

    The samples are new ones: those that told of it have met more of what hides the lamp than others. Pixels, of the
    shape of `rank`, that have changed are true.
    """
    around = np.zeros(cells.rank.shape, dtype=bool)
    computed = np.flatnonzero(cells.lamps >= 0)
    a, b = (half.reshape(3, -1)[:, computed] for half in cells.halves)
    below = ((a + b) < 0.0).any(axis=0)
    if not below.any():
        return around
    negative = np.zeros(cells.lamps.shape, dtype=bool)
    negative.ravel()[computed[below]] = True
    cut = cells.rank >= 0
    around[cut] = any_cell(negative)[cells.rank[cut]]
    around = grown(around, reach_px(cells.grid)) & cut
    again = np.zeros_like(negative)
    again[cells.rank[around]] = cells.lamps[cells.rank[around]] >= 0
    cells.lamps[cells.rank[around]] = -1
    side = np.maximum(*cells.side)
    chosen = np.flatnonzero(again & (side > 1))
    for half in (0, 1):
        _sample_half(film, cells, half, chosen, side.ravel()[chosen], _AGAIN + 2 * turn + half)
    return around


# Rounds: by the noise that was found.


def refine(film: CellSampler, cells: Cells, pixels: Stack, box: Box, budget: float, turn: int) -> Box | None:
    """Sample cells near pixels that are over their budget again; where pixels have changed, None if nowhere.

    Parameters
    ----------
    pixels : array, shape (2, 3, height, width)
        Mean and variance; what changes is folded again.
    box : rows and columns of the window
        Where pixels have changed since they were looked at.
    turn : int, from 1
        Which round this is: each has its own random streams.
    """
    grid, m = cells.grid, cells.grid.margin_px
    over = variance_excess(pixels[0][:, *box], pixels[1][:, *box], grid.blur_sigma_px, budget)
    over[~inner(grid, cells.mirrored)[box]] = 0.0
    found = bounds(over > 1.0)
    if found is None:
        return None
    part = moved_box(found, box[0].start, box[1].start)
    around = np.pad(over[found], m)  # the blur's margin belongs to the window's border
    near, close = (extreme(np.maximum, around, reach) for reach in (reach_px(grid), 1))
    allowed = sum_of_colours(allowed_per_s2(pixels[0][:, *part], grid.blur_sigma_px, budget))
    tight = extreme(np.minimum, np.pad(allowed, m, mode="edge"), 1)
    chosen = near > 1.0
    row, column = (place + one.start for place, one in zip(np.nonzero(chosen), part, strict=True))
    new = (cells.rank[row, column] < 0) & ((close[chosen] > 1.0) | (_of_whole(cells, row, column) > tight[chosen]))
    if new.any():
        _cut(film, cells, row[new], column[new])
    cut = cells.rank[row, column] >= 0
    rank = cells.rank[row, column][cut]
    near, close, tight = (one[chosen][cut][:, None] for one in (near, close, tight))
    side = np.maximum(*(of_rank(one, rank) for one in cells.side))
    ratio = share_of_cell(grid) * sum_of_colours(moments_of(cells, rank)[1]) / tight
    growth = np.clip(np.cbrt(np.minimum(ratio, near) / _AIM), 1.2, _GROWTH)
    wanted = np.where(ratio > _SMALL, _next_side(side * growth), side)
    # little is known of a cell with two samples: it gets more, whatever it seems to need
    wanted = np.where((side == 1) & (close > 1.0), np.maximum(wanted, 2), wanted)
    more = wanted > side
    places = rank[:, None] * grid.cells**2 + np.arange(grid.cells**2)
    for half in (0, 1):
        _sample_half(film, cells, half, places[more], wanted[more], _FIRST + 2 + 2 * turn + half)
    changed = _without_hidden_lamps(film, cells, turn + 1)
    changed[row, column] = True
    strips = list(strips_of(grid, changed))
    for strip in strips:
        fold(cells, pixels, *strip)
    return (
        slice(min(rows.start for rows, _ in strips), max(rows.stop for rows, _ in strips)),
        slice(min(columns.start for _, columns in strips), max(columns.stop for _, columns in strips)),
    )


def _of_whole(cells: Cells, row: NDArray[np.intp], column: NDArray[np.intp]) -> Stack:
    """Share of a pixel's variance that whole pixels have, sum of the colours, as if all around were alike."""
    share = float(np.sum(taps_of_pixels(cells.grid) ** 2) ** 2)
    return np.float32(share / _SMALL) * sum_of_colours(cells.whole[1][:, row, column])


def _all_full(light: Stack) -> NDArray[np.bool_]:
    """Pixels of which all three colours are surely full, shape (rows, columns), by scouts (3, n, rows, columns)."""
    full = is_full(light / np.float32(_SURELY))
    return np.asarray((full[0] & full[1] & full[2]).all(axis=0))
