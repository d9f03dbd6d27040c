"""Spot in a frame of a film under rolling shutter: each row at its own time, smeared, and lit by the blink code.

In the rig's frame it is the spot that moves, so that the chief rays of all instants are one call: the shift of the
spot's image is exact for every row and every node of the exposure. Shape and flux are those of the spot's layer at the
time at which the spot's own row is read. A robot that turns turns that shape as well: by half a degree in an exposure.

The shifted image is that of `sensor.light.moved_spot`, by the sampling theorem with derivatives, with a sum over the
nodes of an exposure instead of a straight smear: w_rj is the laser's level times the weight of node j of row r.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import leggauss

from phibench.render.optics.reflection_point import mirror_points
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.spot_layer import SpotLayer, spot_layer
from phibench.render.sensor.light import Spectrum, layer_spectra
from phibench.render.sensor.settings import SensorError
from phibench.scenes.frames import Array
from phibench.scenes.motion.film_scene import FilmScene
from phibench.scenes.room import Room

_MAX_MOTION_PX = 200.0
_STILL_PX = 1e-7
_SETTLED_S = 1e-13
_ROUNDS = 60
_PARTS = 16  # of an exposure at an edge


def chief_uv_px(scene: FilmScene, times_s: Array) -> Array:
    """Image of the spot's centre through the lens centre, shape (N, 2), at N times; NaN without a reflection."""
    times = np.asarray(times_s, float)
    view = scene.view_at(float(times[0]))
    turns, lenses = scene.camera_at(times)
    from_lens = np.einsum("nji,nj->ni", turns, scene.spot_m(times) - lenses)  # in the rig's axes
    points = from_lens @ turns[0].T + lenses[0]
    eyes = np.broadcast_to(view.camera_centre_m, points.shape)
    found = mirror_points(view, points, eyes)
    return view.rig.camera.project(view.T_world_camera.inverse().points(found.points_m))


def spot_time_s(scene: FilmScene, frame: int) -> float:
    """Time at which the row of the spot's image is read in a frame; that of the frame where there is no image.

    Solves t = t_frame(v(t)). The map contracts: the spot crosses far fewer rows in a read-out than there are.
    """
    middle = time = float(scene.times.frame_s[frame])
    for _ in range(_ROUNDS):
        v = float(chief_uv_px(scene, np.array([time]))[0, 1])
        if not math.isfinite(v):
            return middle
        after = float(scene.times.row_s(frame, v))
        if abs(after - time) < _SETTLED_S:
            return after
        time = after
    return time


@dataclass(frozen=True)
class RowsImage:
    """Spot in one frame: means over each row's exposure, laser code included.

    Attributes
    ----------
    u0_px, v0_px : int
        Image pixel of the window's first column and row.
    electrons_per_s, du_electrons_per_s_px, dv_electrons_per_s_px : arrays, shape (3, h, w)
        Mean over the exposure, and its derivatives by a shift of the whole image of the spot by +u, +v.
    """

    u0_px: int
    v0_px: int
    electrons_per_s: Array
    du_electrons_per_s_px: Array
    dv_electrons_per_s_px: Array

    @property
    def origin_px(self) -> tuple[int, int]:
        """(u, v) of the window's first pixel."""
        return self.u0_px, self.v0_px

    @property
    def stacks(self) -> Array:
        """Mean and both derivatives, shape (3, 3, h, w)."""
        return np.stack([self.electrons_per_s, self.du_electrons_per_s_px, self.dv_electrons_per_s_px])


def rows_image(scene: FilmScene, frame: int, layer: SpotLayer, time_s: float) -> RowsImage:
    """Image of the spot in a frame.

    Parameters
    ----------
    layer : SpotLayer
        Of the still at `time_s`.
    time_s : float
        `spot_time_s` of the frame.

    Raises
    ------
    SensorError
        If the spot crosses more than 200 pixels in a frame.
    """
    if layer.electrons_per_s.max(initial=0.0) == 0.0:
        return RowsImage(0, 0, *np.zeros((3, 3, 0, 0)))
    times = scene.times
    height = layer.electrons_per_s.shape[1]
    reach = _reach_px(scene, frame, layer, time_s)
    margin = math.ceil(reach) + 2 if reach > _STILL_PX else 0
    rows = layer.v0_px - margin + np.arange(height + 2 * margin)
    nodes, weights = exposure_nodes(scene, times.row_s(frame, rows), 3 + math.ceil(2.0 * reach))
    if margin == 0:
        level = weights.sum(axis=1)[:, None]
        stacks = (layer.electrons_per_s, layer.du_electrons_per_s_px, layer.dv_electrons_per_s_px)
        return RowsImage(layer.u0_px, layer.v0_px, *(stack * level for stack in stacks))
    uv = chief_uv_px(scene, np.concatenate([[time_s], nodes.ravel()]))
    shift = np.where(np.isfinite(uv[1:]), uv[1:] - uv[0], 0.0).reshape(*nodes.shape, 2)
    images = _shifted(layer, margin, shift, weights)
    return RowsImage(layer.u0_px - margin, layer.v0_px - margin, *images)


def parted_image(scene: FilmScene, room: Room, frame: int) -> RowsImage:
    """Image of the spot in a frame as the mean over parts of the exposure, each with the layer at its middle.

    For a spot that goes behind something, or comes out: its flux and its shape change within an exposure.
    """
    exposure_s, images = scene.times.exposure_s / _PARTS, []
    for part in range(_PARTS):
        later_s = (part + 0.5 - 0.5 * _PARTS) * exposure_s
        times = replace(scene.times, exposure_s=exposure_s, first_s=scene.times.first_s + later_s)
        short = replace(scene, times=times)
        at = spot_time_s(short, frame)
        view = scene.view_at(at)
        images.append(rows_image(short, frame, spot_layer(view, scene.spot_at(at), room_geometry(room, view)), at))
    return _mean_image(images)


def _mean_image(images: Sequence[RowsImage]) -> RowsImage:
    """Mean of images that may have other windows; one without pixels is dark."""
    lit = [one for one in images if one.electrons_per_s.size]
    if not lit:
        return images[0]
    u0, v0 = min(one.u0_px for one in lit), min(one.v0_px for one in lit)
    u1, v1 = (max(one.origin_px[k] + one.electrons_per_s.shape[2 - k] for one in lit) for k in (0, 1))
    total = np.zeros((3, 3, v1 - v0, u1 - u0))
    for one in lit:
        height, width = one.electrons_per_s.shape[1:]
        v, u = one.v0_px - v0, one.u0_px - u0
        total[:, :, v : v + height, u : u + width] += one.stacks
    return RowsImage(u0, v0, *(total / len(images)))


def exposure_nodes(scene: FilmScene, middle_s: Array, count: int) -> tuple[Array, Array]:
    """Nodes within the exposures about `middle_s`, shape (N,), and their weights with the laser's level, (N, M).

    Gauss-Legendre on every piece of an exposure, between changes of the laser and waypoints of the spot.
    """
    exposure, code = scene.times.exposure_s, scene.code
    if exposure == 0.0:
        return middle_s[:, None], code.level(middle_s)[:, None]
    low, high = middle_s - 0.5 * exposure, middle_s + 0.5 * exposure
    edges = [low, high]
    if code.duration_s > 0.0:
        first = np.ceil((low - code.start_s) / code.bit_s)
        for number in range(math.ceil(exposure / code.bit_s) + 1):
            edges.append(np.clip(code.start_s + (first + number) * code.bit_s, low, high))
    turns_s = [one.time_s for one in scene.path.waypoints if low.min() < one.time_s < high.max()]
    edges += [np.clip(time_s, low, high) for time_s in turns_s]
    ordered = np.sort(edges, axis=0)
    x, weight = leggauss(count)
    pieces = [
        (0.5 * (a + b)[:, None] + 0.5 * (b - a)[:, None] * x, (0.5 * (b - a) * code.level(0.5 * (a + b)))[:, None])
        for a, b in itertools.pairwise(ordered)
    ]
    return np.hstack([node for node, _ in pieces]), np.hstack([part * weight for _, part in pieces]) / exposure


def _reach_px(scene: FilmScene, frame: int, layer: SpotLayer, time_s: float) -> float:
    """Largest shift of the spot's image within the exposures of the rows that it may touch, pixels."""
    height = layer.electrons_per_s.shape[1]
    reach = 0.0
    for _ in range(2):  # rows beyond the window count once the spot is known to reach them
        rows = np.array([layer.v0_px - reach - 2, layer.v0_px + height + reach + 1])
        middle = scene.times.row_s(frame, rows)
        half = 0.5 * scene.times.exposure_s
        uv = chief_uv_px(scene, np.concatenate([[time_s], np.linspace(middle[0] - half, middle[1] + half, 33)]))
        apart = np.linalg.norm(uv[1:] - uv[0], axis=1)
        reach = float(np.nanmax(apart, initial=0.0))
        if reach > _MAX_MOTION_PX:
            raise SensorError(
                f"frame {frame}: the spot moves by {reach:.0f} px in a frame, {_MAX_MOTION_PX:.0f} are allowed; "
                "move carriage or target more slowly, or shorten exposure and read-out"
            )
    return reach


def _shifted(layer: SpotLayer, margin: int, shift_px: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Image and its two derivatives, shape (3, rows, columns) each, of shifts (rows, nodes, 2)."""
    rows, columns = (n + 2 * margin for n in layer.electrons_per_s.shape[1:])
    images = np.zeros((3, 3, rows, columns))
    for spectrum, kv, ku in layer_spectra(layer, margin):
        turn = 2j * np.pi
        # (nodes, rows, kv): where the row's centre lies in the unshifted image
        down = np.exp(turn * kv * (np.arange(rows)[None, :] - shift_px[..., 1].T)[..., None])
        sideways = weights.T[..., None] * np.exp(-turn * ku * shift_px[..., 0].T[..., None])  # (nodes, rows, ku)
        across = np.exp(turn * ku[:, None] * np.arange(columns))
        slopes = (spectrum, -turn * ku * spectrum, -turn * kv[:, None] * spectrum)
        for number, one in enumerate(slopes):
            part = _rows_of(one, down, sideways)
            images[number] += (part @ across).real / (len(kv) * len(ku))
    return images[0], images[1], images[2]


def _rows_of(spectrum: Spectrum, down: Spectrum, sideways: Spectrum) -> Spectrum:
    """Sum over nodes of (down @ spectrum) x sideways, shape (3, rows, ku)."""
    return np.stack([np.einsum("jrk,jrk->rk", down @ plane, sideways) for plane in spectrum])
