"""Two sensors side by side (the paper's H-binocular): error of D by distance, and what each hides from the other.

To one sensor the other is matter of the room: its ball as a mesh, its camera's housing and its mast. So both sensors
are rendered in the ordinary way, and what they hide from each other is read off rendered spots. The competitor's laws
are read off fits to drawn frames: the error of D, over that of the pixels, against D and the distance b of the two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from phibench.estimator.geometry.triangulate import depth_exact
from phibench.render.optics.room_tracer import RoomGeometry, as_geometry
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.sensor.settings import Sensor
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import carriage
from phibench.scenes.shapes import Mesh, Shape, Uniform
from phibench.studies.framework import Finding
from phibench.studies.isotropy.azimuth_errors import NORMAL_95, fitted_px, flat_pair, sideways_rig
from phibench.studies.isotropy.lines import moved_rig
from phibench.studies.misaligned_rigs import spot_of

_ROWS, _COLUMNS = 36, 72  # of the ball's mesh: chords lie up to 0.1 % of the radius inside
_BALL = (0.6, 0.6, 0.6)  # albedo of the ball that stands in for polished steel
_LOG2_PAIRS = 8  # of points on spot and lens: which part of the light passes is wanted to a few per cent
_HALF = 0.5  # of a spot's light: below it the spot counts as hidden
_WIDEST_DEG = 40.0  # of hidden azimuths beside the other camera: none reaches as far
_HALVINGS = 9  # of the widest angle: 0.08 degrees, less than a spot
_WORDS = {"depth_m": "D", "apart_m": "their distance"}
_LEAST_FITS = 2  # of a place for a scatter, and places for a power
_PLACES_PX = (0.0, 0.5, 1.0, 1.5)  # per axis, over the two pixels of a Bayer cell
_ACROSS_RAD = 0.5 * math.pi  # azimuth of the spots that show the laws: across the baseline


def sensor_solids(view: View, name: str) -> tuple[Shape, ...]:
    """A sensor as others see it: ball, camera housing and mast."""
    parts = (replace(part, name=f"{name}_{part.name}") for part in carriage(view))
    return (_ball(view, f"{name}_ball"), *parts)


def _ball(view: View, name: str) -> Mesh:
    """Mesh of a sphere, its faces half a chord's height outside and inside it."""
    polar = np.linspace(0.0, math.pi, _ROWS + 1)[:, None]
    turn = np.arange(_COLUMNS) * (2.0 * math.pi / _COLUMNS)
    unit = np.stack(
        [np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar) + 0.0 * turn], axis=-1
    ).reshape(-1, 3)
    i, j = (each.ravel() for each in np.mgrid[:_ROWS, :_COLUMNS])
    k = (j + 1) % _COLUMNS
    a, b, c, d = (_COLUMNS * row + column for row, column in ((i, j), (i + 1, j), (i + 1, k), (i, k)))
    upper, lower = i > 0, i < _ROWS - 1  # at the poles one of a cell's triangles has no area
    triangles = np.concatenate([np.stack([a, b, c], axis=-1)[lower], np.stack([a, c, d], axis=-1)[upper]])
    radius = view.rig.sphere.radius_m / math.cos(0.5 * math.pi / _COLUMNS)
    return Mesh(name, view.sphere_centre_m + radius * unit, triangles, Uniform(_BALL))


@dataclass(frozen=True)
class Binocular:
    """Two sensors; the second stands `apart_m` from the first along world x. Spots stand about the first one."""

    rig: Rig
    apart_m: float
    depth_m: float
    height_m: float

    @property
    def views(self) -> tuple[View, View]:
        """Views of the first and the second sensor."""
        return self.rig.at(0.0), moved_rig(self.rig, self.apart_m).at(0.0)

    def seen_beside(self, index: int) -> tuple[Shape, ...]:
        """Shapes of the other sensor, which stand in the images of one."""
        return sensor_solids(self.views[1 - index], "second" if index == 0 else "first")

    def hidden_deg(self, index: int, height_m: float) -> float:
        """Width of the azimuths, about the first sensor, whose rendered spots one sensor does not see, degrees.

        A spot is hidden if the other sensor takes more than half of its light. The hidden azimuths are those about the
        direction of the other sensor; the border on each side is found by halving.
        """
        view, depth_m = self.views[index], self.depth_m
        free = as_geometry(carriage(view))
        full = as_geometry((*carriage(view), *self.seen_beside(index)))
        towards = 180.0 * index

        def hidden(angle_deg: float) -> bool:
            turn = math.radians(towards + angle_deg)
            point = np.array([depth_m * math.cos(turn), depth_m * math.sin(turn), height_m])
            return _light(view, point, full) < _HALF * _light(view, point, free)

        return sum(_border_deg(hidden, side * _WIDEST_DEG) for side in (1.0, -1.0)) if hidden(0.0) else 0.0

    def hidden_share(self, height_m: float) -> float:
        """Share of all azimuths at which one of the two does not see a spot at a height."""
        return sum(self.hidden_deg(index, height_m) for index in (0, 1)) / 360.0


def _light(view: View, point_m: Array, geometry: RoomGeometry) -> float:
    """Electrons per second of a rendered spot."""
    return float(np.sum(spot_layer(view, spot_of(point_m), geometry, _LOG2_PAIRS).electrons_per_s))


def _border_deg(hidden: Callable[[float], bool], beyond_deg: float) -> float:
    """Angle from 0, where spots are hidden, to the border towards an angle at which they are not."""
    inside, outside = 0.0, beyond_deg
    for _ in range(_HALVINGS):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if hidden(middle) else (inside, middle)
    return abs(0.5 * (inside + outside))


# -- laws --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Gain:
    """Scatter of D in frames of one D and distance of the sensors.

    Attributes
    ----------
    scatter_m, scatter_px : float
        Standard deviations of D, and of the fitted pixels, all four coordinates together, over places in a mosaic cell.
    draws : int
        One more than the degrees of freedom.
    rays_m_per_px : float
        Error of D by pixels with equal errors in all coordinates, from the rays alone.
    """

    depth_m: float
    apart_m: float
    scatter_m: float
    scatter_px: float
    draws: int
    rays_m_per_px: float

    @property
    def m_per_px(self) -> float:
        """Error of D per error of the pixels."""
        return self.scatter_m / self.scatter_px


@dataclass(frozen=True)
class Laws:
    """Values of D with the distance as it is, of the distance with D as it is, and frame pairs of each."""

    draws: int
    depths_m: Sequence[float] = (1.2, 1.7, 2.4, 3.4)
    apart_m: Sequence[float] = (0.3, 0.425, 0.6, 0.85)


def scatter_gain(both: Binocular, light: Array, sensor: Sensor, draws: int) -> Gain | None:
    """Scatter from drawn frames of a spot across the baseline, on an even background of this light.

    The frames are shared out to places in a cell of the mosaic, as the noise of one place is that of no other. None
    where one of the two does not see the spot, or fits do not find it.
    """
    D, b = both.depth_m, both.apart_m
    point = np.array([D * math.cos(_ACROSS_RAD), D * math.sin(_ACROSS_RAD), both.height_m])
    each, degrees = max(-(-draws // len(_PLACES_PX) ** 2), 2), 0
    squares = []
    for du in _PLACES_PX:
        for dv in _PLACES_PX:
            camera = replace(both.rig.camera, cx_px=both.rig.camera.cx_px + du, cy_px=both.rig.camera.cy_px + dv)
            pair = flat_pair(sideways_rig(replace(both.rig, camera=camera)), b, point, light)
            if pair is None:
                return None  # one of the cameras does not see it
            uv = fitted_px(pair, sensor, each, "study", "isotropy", "binocular", f"{D:g}", f"{b:g}", f"{du:g} {dv:g}")
            depth = depth_exact(pair.rig, b, uv[0], uv[1]).depth_m
            measured_pairs = np.isfinite(depth)
            if measured_pairs.sum() < _LEAST_FITS:
                continue  # too few fits for a variance
            by_rays = depth_exact(pair.rig, b, pair.uv_px[0], pair.uv_px[1], np.eye(2), np.eye(2)).sigma_m
            squares.append(
                [
                    np.var(depth[measured_pairs], ddof=1),
                    np.mean(np.var(uv[:, measured_pairs], axis=1, ddof=1)),
                    by_rays**2,
                ]
            )
            degrees += int(measured_pairs.sum()) - 1
    if not squares:
        return None
    scatter_m, scatter_px, rays = (float(value) for value in np.sqrt(np.mean(squares, axis=0)))
    return Gain(D, b, scatter_m, scatter_px, degrees + 1, rays)


def error_power(rows: Sequence[Gain], of: str, error: str = "m_per_px") -> tuple[float, float]:
    """Power of `depth_m` or `apart_m` with which the error of D per pixel grows, and its standard error.

    A standard deviation of n draws is good to one part in sqrt(2 (n - 1)).
    """
    x, y = np.log([getattr(row, of) for row in rows]), np.log([getattr(row, error) for row in rows])
    spread = x - x.mean()
    sigma = 1.0 / math.sqrt(2.0 * (min(row.draws for row in rows) - 1))
    return float(spread @ y / (spread @ spread)), sigma / float(np.sqrt(spread @ spread))


def binocular_results(
    both: Binocular, heights_m: Sequence[float], laws: Laws, light: Array, sensor: Sensor
) -> Iterator[Finding]:
    """Render both sensors' spots, draw their frames, and state what they show."""
    shares = [(height, both.hidden_share(height)) for height in heights_m]
    varied = {
        "depth_m": [replace(both, depth_m=depth) for depth in laws.depths_m],
        "apart_m": [replace(both, apart_m=apart) for apart in laws.apart_m],
    }
    tries = {of: [scatter_gain(pair, light, sensor, laws.draws) for pair in pairs] for of, pairs in varied.items()}
    gains = {of: [row for row in rows if row is not None] for of, rows in tries.items()}
    return binocular_findings(shares, {of: rows for of, rows in gains.items() if len(rows) >= _LEAST_FITS})


def binocular_findings(shares: Sequence[tuple[float, float]], laws: Mapping[str, Sequence[Gain]]) -> Iterator[Finding]:
    """Hidden shares (height, share) by images, and powers by the length that was changed."""
    for height_m, share in shares:
        yield Finding(f"hidden from each other, by rendered spots, spot at {height_m:g} m", 100.0 * share, unit="%")
    for of, rows in laws.items():
        value, sigma = error_power(rows, of)
        ends = (value, value - NORMAL_95 * sigma, value + NORMAL_95 * sigma)
        yield Finding.ranged(f"two sensors, error of D per pixel, by images: power of {_WORDS[of]}", ends)
        by_rays = error_power(rows, of, "rays_m_per_px")[0]
        yield Finding(f"two sensors, error of D per pixel, by rays: power of {_WORDS[of]}", by_rays)
