"""Lights of a mesh room: evenly shining rectangles as lamps; triangles with emission textures cut into lit and dark.

A panel of a double-sided material shines to both sides. OBJ has no sides. Where one side of such a panel is closed by
a ceiling or a housing, the lamp shines to the other one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.rooms.mesh_parts import MeshPart, Paint
from phibench.datasets.rooms.mesh_placement import MeshSettings, corners_of, meets_box
from phibench.render.sensor.srgb import srgb_decoded
from phibench.scenes.frames import Array, Pose, as_matrix, as_vector
from phibench.scenes.shapes import Rectangle, Uniform, rectangle

MOST_LAMPS = 12
"""Rectangles that are sampled as lamps; what else shines is found by chance alone."""
_LINEAR = srgb_decoded(np.arange(256) / 255.0)  # of every code of a picture
_LEAST_LIGHT = 1e-3  # of an emission texture: below it a texel counts as dark
_BLACK = Uniform((0.0, 0.0, 0.0))
_SQUARE = 1e-4  # by which a rectangle's sides and angles may be off
_MOST_PANELS = 300  # of a part, the largest, that are looked at: few become lamps
_CLOSED_M = 0.06  # from a panel: what is nearer closes its side
_APART_M = 1e-3  # between the two lamps of a panel that shines to both sides
_FARTHEST = 1e9  # texels from a picture: beyond, integers would end
_FINE_M = 0.1  # longest side of a piece that is not cut further
_CUTS = 7  # into four, one after the other
_MOST_PIECES = 50_000  # of a part
_DARK = 0.1  # of a triangle's area: one that is dark by less shines as a whole


# Pictures that shine in places.


@dataclass
class LitPictures:
    """Sums over the lit texels of pictures, each made once."""

    _sums: dict[tuple[int, tuple[float, ...]], NDArray[np.uint32]] = field(default_factory=dict)

    def share(self, light: Paint, uv: Array) -> Array:
        """Part of the texels around each triangle, shape (M,), that shine, of those that interpolation takes.

        Parameters
        ----------
        light : Paint with a picture
        uv : shape (M, 3, 2)
        """
        sums = self._of(light)
        size = np.array(sums.shape[::-1]) - 1
        texel = np.clip(uv * size, -_FARTHEST, _FARTHEST)
        low = np.floor(texel.min(axis=1) - 0.5 + _SQUARE).astype(np.int64)
        high = np.floor(texel.max(axis=1) - 0.5 - _SQUARE).astype(np.int64) + 2
        high = np.minimum(np.maximum(high, low + 1), low + size)  # all around once is all
        lit = sum(
            sign * _repeated_sum(sums, x, y)
            for sign, x, y in (
                (1, high[:, 0], high[:, 1]),
                (-1, low[:, 0], high[:, 1]),
                (-1, high[:, 0], low[:, 1]),
                (1, low[:, 0], low[:, 1]),
            )
        )
        return np.asarray(lit / (high - low).prod(axis=1))

    def _of(self, light: Paint) -> NDArray[np.uint32]:
        assert light.picture is not None
        key = (id(light.picture), tuple(light.colour))
        if key not in self._sums:
            rows, columns = light.picture.shape[:2]
            lit = np.zeros((rows + 1, columns + 1), np.uint32)
            for k, factor in enumerate(light.colour):
                lit[1:, 1:] |= (_LINEAR * factor > _LEAST_LIGHT)[light.picture[::-1, :, k]]
            np.cumsum(lit, axis=0, out=lit)
            self._sums[key] = np.cumsum(lit, axis=1, out=lit)
        return self._sums[key]


def _repeated_sum(sums: NDArray[np.uint32], x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sum from texel 0 up to column x and row y of a picture that repeats; below 0 on the other side."""
    rows, columns = sums.shape[0] - 1, sums.shape[1] - 1
    (across, x), (up, y) = np.divmod(x, columns), np.divmod(y, rows)
    once = [sums[place].astype(np.int64) for place in ((-1, -1), (y, -1), (-1, x), (y, x))]
    return np.asarray(across * up * once[0] + across * once[1] + up * once[2] + once[3])


def split_by_light(part: MeshPart, lit: LitPictures) -> Iterator[MeshPart]:
    """Part whose emission is a picture, as pieces that shine and those that do not; any other part as it is.

    What shines reflects nothing. A triangle that is dark by a tenth or more is therefore cut, unless it is black.
    """
    if part.light is None or part.light.picture is None or part.light.uv is None:
        yield part
        return  # one light for the whole part
    owner, weights, shines = _pieces(part, part.light, lit)
    corners = weights @ corners_of(part)[owner]
    pieces = replace(
        part,
        vertices=corners.reshape(-1, 3),
        triangles=np.arange(3 * len(owner)).reshape(-1, 3),
        paint=None if part.paint is None else part.paint.pieces(owner, weights),
        light=part.light.pieces(owner, weights),
    )
    whole = part if len(owner) == len(part.triangles) else pieces
    if shines.any():
        yield whole.of(shines, f"{part.name} (light)")
    if not shines.all():
        yield replace(whole.of(~shines, part.name), light=None)


def _pieces(part: MeshPart, light: Paint, lit: LitPictures) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Triangle that each piece is of, weights of its corners, shape (N, 3, 3), and whether it shines."""
    assert light.uv is not None
    corners, uv, count = corners_of(part), light.uv, len(part.triangles)
    owner, weights, found, number = np.arange(count), np.tile(np.eye(3), (count, 1, 1)), [], 0
    for cuts in range(_CUTS + 1):
        share = lit.share(light, weights @ uv[owner])
        points = weights @ corners[owner]
        side = np.linalg.norm(points - np.roll(points, 1, axis=1), axis=2).max(axis=1)
        is_last = cuts == _CUTS or number + 4 * len(owner) > _MOST_PIECES
        ready = (share == 0.0) | (share == 1.0) | (side < _FINE_M) | is_last
        found.append((owner[ready], weights[ready], share[ready] > 0.0, np.full(ready.sum(), 0.25**cuts)))
        number += int(ready.sum())
        if ready.all():
            break
        a, b, c = np.moveaxis(weights[~ready], 1, 0)
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        four = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        weights = np.concatenate([np.stack(three, axis=1) for three in four])
        owner = np.tile(owner[~ready], 4)
    owner, weights, shines, area = (np.concatenate(each) for each in zip(*found, strict=True))
    dark = np.bincount(owner, np.where(shines, 0.0, area), count)
    reflects = part.paint is None or max(part.paint.colour) > 0.0
    is_cut = (dark >= _DARK) & (dark < 1.0) & reflects
    kept, rest = np.flatnonzero(~is_cut), is_cut[owner]
    owner = np.concatenate([kept, owner[rest]])
    order = np.argsort(owner, kind="stable")
    weights = np.concatenate([np.tile(np.eye(3), (len(kept), 1, 1)), weights[rest]])
    shines = np.concatenate([dark[kept] < 1.0, shines[rest]])
    return owner[order], weights[order], shines[order]


# Lamps.


def lamps_of(settings: MeshSettings, parts: list[MeshPart]) -> tuple[tuple[Rectangle, ...], list[MeshPart]]:
    """Rectangles that shine evenly, the strongest of them as lamps, and all other parts."""
    lamps = [
        rectangle(
            f"lamp_{k}", lamp.centre_m, lamp.normal, lamp.size_m, texture=_BLACK, radiance_w_m2_sr=lamp.radiance_w_m2_sr
        )
        for k, lamp in enumerate(settings.lamps, 1)
    ]
    panels: list[tuple[float, Rectangle, int, NDArray[np.int64]]] = []
    for number, part in enumerate(parts):
        if part.light is None or part.light.picture is not None:
            continue  # dark, or bright in places: no lamp
        radiance = as_vector(settings.emission_w_m2_sr * np.array(part.light.colour))
        for count, (pair, pose, size) in enumerate(_rectangles(part), 1):
            name = f"{part.name} (lamp {count})"
            panel = Rectangle(name, pose, size, _BLACK, radiance)
            panels.append((max(radiance) * size[0] * size[1], panel, number, pair))
    panels.sort(key=lambda each: (-each[0], each[1].name))
    rest = {number: np.ones(len(part.triangles), dtype=bool) for number, part in enumerate(parts)}
    is_obj = settings.path.suffix.lower() == ".obj"
    everything: Array | None = None
    for _, panel, number, pair in panels:
        if len(lamps) >= MOST_LAMPS:
            break
        both, sides = parts[number].two_sided, [panel]
        if both or is_obj:
            everything = np.concatenate([corners_of(part) for part in parts]) if everything is None else everything
            sides = _open_sides(panel, everything, both)
        if len(lamps) + len(sides) <= MOST_LAMPS:
            lamps += sides
            rest[number][pair] = False
    left = [(part, rest[number]) for number, part in enumerate(parts) if rest[number].any()]
    return tuple(lamps), [part if keep.all() else part.of(keep, part.name) for part, keep in left]


def _open_sides(panel: Rectangle, corners: Array, both: bool) -> list[Rectangle]:
    """Lamps of a panel without a back: on the side that alone is open, else on its front, or on both of them."""
    pose, half = panel.T_world_shape, 0.5 * np.array(panel.size_m)
    near = np.linalg.norm(half) + _CLOSED_M
    far = (corners.min(axis=1) > pose.t + near).any(axis=1) | (corners.max(axis=1) < pose.t - near).any(axis=1)
    local = (corners[~far] - pose.t) @ pose.R
    low, high = np.array([*(-0.5 * half), _APART_M]), np.array([*(0.5 * half), _CLOSED_M])  # of its middle
    front = bool(meets_box(local, low, high).any())
    back = bool(meets_box(local, low * [1, 1, 0] - [0, 0, _CLOSED_M], high * [1, 1, 0] - [0, 0, _APART_M]).any())
    turned = np.array(pose.R) * [1.0, -1.0, -1.0]
    if front != back or not both:
        return [_lamp(panel, pose.t, turned if front and not back else pose.R)]
    away = 0.5 * _APART_M * np.array(pose.R)[:, 2]  # two at one place would hide each other
    return [
        _lamp(panel, pose.t + away, pose.R),
        replace(_lamp(panel, pose.t - away, turned), name=f"{panel.name} back"),
    ]


def _lamp(panel: Rectangle, t: Array, R: Array) -> Rectangle:
    return replace(panel, T_world_shape=Pose("world", "shape", as_vector(t), as_matrix(R)))


def _rectangles(part: MeshPart) -> Iterator[tuple[NDArray[np.int64], Pose, tuple[float, float]]]:
    """Yield pairs of triangles that touch no other and make a rectangle, of the largest ones: which, pose, size."""
    from scipy.sparse import coo_array  # here, as every command reads recipes, and few a mesh with lamps
    from scipy.sparse.csgraph import connected_components

    corners, index = corners_of(part), merged_places(part)
    count = len(index)
    rows = np.repeat(np.arange(count), 3)
    links = coo_array((np.ones(3 * count), (rows, count + index.ravel())), shape=(count + index.max() + 1,) * 2)
    label = connected_components(links, directed=False)[1][:count]
    order = np.argsort(label, kind="stable")
    sizes = np.bincount(label)
    starts = (np.cumsum(sizes) - sizes)[sizes == 2]
    pairs = order[starts[:, None] + [0, 1]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    largest = np.sort(np.argsort(-area[pairs].sum(axis=1), kind="stable")[:_MOST_PANELS])
    for pair in pairs[largest]:
        frame = _rectangle_frame(corners[pair], index[pair])
        if frame is not None:
            yield pair, *frame


def _rectangle_frame(corners: Array, index: NDArray[np.int64]) -> tuple[Pose, tuple[float, float]] | None:
    """Pose and size of the rectangle of two triangles, shape (2, 3, 3); None if they make none.

    Each has one corner that the other lacks, the right angle; the two are opposite each other.
    """
    own = [np.flatnonzero(~np.isin(index[k], index[1 - k])) for k in (0, 1)]
    if len(own[0]) != 1 or len(own[1]) != 1:
        return None  # two triangles that share no edge
    first = np.roll(corners[0], -int(own[0][0]), axis=0)
    along, up = first[1] - first[0], first[2] - first[0]
    a, b, normal = float(np.linalg.norm(along)), float(np.linalg.norm(up)), np.cross(along, up)
    other = np.cross(corners[1][1] - corners[1][0], corners[1][2] - corners[1][0])
    off = float(np.linalg.norm(first[0] + along + up - corners[1][int(own[1][0])]))
    square = abs(float(along @ up)) <= _SQUARE * a * b and off <= _SQUARE * (a + b)
    if not square or float(normal @ other) <= 0.0:
        return None  # no rectangle, or folded
    x, z = along / a, normal / np.linalg.norm(normal)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    return Pose("world", "shape", as_vector(first[0] + 0.5 * (along + up)), as_matrix(R)), (a, b)


_MIXING = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)  # odd, of no pattern


def merged_places(part: MeshPart) -> NDArray[np.int64]:
    """Index of the place of each corner, shape (M, 3); what is less than about a micrometre apart is one place.

    Places are told apart by a 64-bit sum of their coordinates: two of a million collide with a chance of 3e-8.
    """
    grid = np.rint(part.vertices * 1e6).astype(np.int64).view(np.uint64)  # micrometres: the same corner written twice
    place = np.unique((grid * _MIXING).sum(axis=1), return_inverse=True)[1].reshape(-1)
    return np.asarray(place[part.triangles], np.int64)
