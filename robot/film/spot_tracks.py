"""Spots in the whole frames of a film, and their tracks: detection, association, and the light of every frame.

Detection has two parts. The map and the test of `spots.candidates`, as for stills, finds what has a spot's shape.
The difference from two frames before finds what has become brighter, on edges of the room as well, which are no longer
there. (From the frame just before it would miss a bit that begins in the middle of an exposure.) Thresholds are low,
and colour is not asked: the blink code tells the target from what merely looks like a spot.

Association. A track is a Kalman filter of constant velocity in pixels (`filterpy`). Spots of a frame go to tracks by
global nearest neighbours: the least sum of squared Mahalanobis distances, each within a gate
(`scipy.optimize.linear_sum_assignment`). Spots are few, sharp and some pixels apart, and the code identifies them.
Joint probabilities or several hypotheses, as Stone Soup has them, would gain where spots cross, which is rare.

Light. The amplitude of every track is measured in every frame, also where nothing was detected: at the place that the
filter predicts, and back to before a track began. A dark frame says as much of a code as a bright one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, maximum_filter
from scipy.optimize import linear_sum_assignment

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.status import Status
from phibench.estimator.interface import Box
from phibench.estimator.spots.candidates import candidates_at, peaks
from phibench.estimator.spots.detect import lamp_halo, mirror_box, outline_mask
from phibench.estimator.spots.fit_raw import fit_law
from phibench.estimator.spots.gaussian_spot import SpotModel
from phibench.estimator.spots.image_planes import ColourPlanes, blur_of, colour_planes, variance_e2
from phibench.estimator.spots.raw_pixels import GaussLaw, noise_of, raw_electrons, spot_regions
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.robot.film.film_positions import FilmPositions
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

LEAST_Z = 4.8  # of a spot: one false one in a frame of noise at most, see `spots.detect`
_LEAST_CHANGE = 5.0  # of a light that becomes brighter
_LEAST_FOLLOWING = 7.0  # of a light that follows a code over many frames: no noise of a million places does
_LEAST_SITE, _MOST_SITES = 3.5, 25  # of a red site and its neighbours, before the test
_APART_PX = 3.0  # of a changed light from a spot that is found anyway
_CROSS = 0.5 * np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)], float)
_SIDE_SHARE = 0.3  # of a spot's light in the next site, about
_SAME_PX = 1.0  # of a track from a light that follows a code
_OFFSETS = 0.5 * np.stack(np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)), axis=-1).reshape(-1, 2)
_LEAST_PEAK = 4.0  # of the map; low, because the code must agree, too
_MOST_PEAKS = 600  # of a frame, the strongest
_GATE2 = 16.0  # chi squared of 2: 3e-4 of a track's own spots lie beyond
_FARTHEST_PX = 4.0  # of a track's own spot from where it is expected, however long it was dark
_PLACE_PX = 0.35  # of a detection: noise of a spot of 7 sigma, and minima of the mosaic
_SPEED_PX, _MOVING_PX = 0.1, 1.0  # per frame, of a track at its first spot: at rest, and while something moves
_AGILITY = 5e-4 * np.kron(np.eye(2), [[1.0 / 3.0, 0.5], [0.5, 1.0]])  # pixels and frames, at rest
_MOVING = 100.0  # times that, while something moves: a stroke of 0.25 m/s speeds up by 0.2 px a frame in a frame
_BACK = 4  # frames before the first spot that are measured: a code's longest dark run and one more
_KEPT = 15  # frames over which a code may be followed
_REMEMBERED = 90  # frames whose pixels are kept, for positions of a target once it is known: 1 MB each
_TENTATIVE = 2  # spots up to which a track may be noise
WINDOW_PX = 9  # kept around every spot, for a fit of its place: a level per filter describes the room there


@dataclass(frozen=True)
class FrameSpots:
    """Spots of one frame: places (n, 2), amplitudes and their standard deviations, electrons, shape (n,)."""

    uv_px: Array
    electrons: Array
    sigma_e: Array

    def __len__(self) -> int:
        return len(self.uv_px)


class FrameSearch:
    """Search of spots in whole frames of one camera.

    Parameters
    ----------
    rig : Rig
        Nominal: its mirror's outline and its blur.
    box : Box, optional
        Part of the image to search, which begins at an even row and column; all that holds the mirror by default.

    Attributes
    ----------
    inside : shape (h, w), bool
        Pixels of the box that show the mirror.
    """

    def __init__(self, rig: Rig, card: SensorCard, box: Box | None = None) -> None:
        self.card, self.box = card, box or mirror_box(rig)
        self.sigma_px = blur_of(card, rig.camera.blur_sigma_px)
        self.inside = outline_mask(rig, self.box)
        self._origin = np.array([self.box.u0_px, self.box.v0_px], float)

    def planes(self, image: NDArray[Any]) -> ColourPlanes:
        """Planes of the part of a frame that holds the mirror.

        Raises
        ------
        ValueError
            If the image does not fit the card's output.
        """
        return colour_planes(image, self.card, self.box)

    def part(self, image: NDArray[Any]) -> NDArray[Any]:
        """Box of an image."""
        return image[self.box.slices]

    def spots(self, planes: ColourPlanes, before: ColourPlanes | None = None) -> FrameSpots:
        """Spots of a frame, the brightest first; `before` is an earlier frame, from which lights may be brighter."""
        # full pixels alone count as lamps: what is merely bright is steady, and the code tells it from the target
        where = self.inside & ~lamp_halo(planes, self.inside, self.card, True)
        places = peaks(planes, None, self.card, self.sigma_px, where, _LEAST_PEAK, _MOST_PEAKS).uv_px
        tests = candidates_at(planes, None, self.card, places, self.sigma_px)
        keep = np.flatnonzero(tests.z >= LEAST_Z)
        uv = self._refined(planes, None, tests.uv_px[keep])
        if before is not None and len(more := self._brighter(planes, before, where)):
            more = self._refined(planes, before, more)
            apart = np.linalg.norm(more[:, None] - uv[None], axis=-1).min(axis=1, initial=np.inf) > _APART_PX
            uv = np.concatenate([uv, more[apart]])
        light = candidates_at(planes, None, self.card, uv, self.sigma_px)
        order = np.argsort(-light.electrons, kind="stable")
        return FrameSpots(uv[order] + self._origin, light.electrons[order], light.sigma_e[order])

    def _refined(self, planes: ColourPlanes, off: ColourPlanes | None, uv_px: Array) -> Array:
        """Places at the vertex of a parabola along u and one along v through the gain A^2 / variance."""
        around = (uv_px[:, None] + _CROSS).reshape(-1, 2)
        tests = candidates_at(planes, off, self.card, around, self.sigma_px)
        gain = ((np.maximum(tests.electrons, 0.0) / tests.sigma_e) ** 2).reshape(len(uv_px), len(_CROSS))
        shift = np.zeros((len(uv_px), 2))
        for axis, (low, high) in enumerate(((1, 2), (3, 4))):
            bend = gain[:, low] - 2.0 * gain[:, 0] + gain[:, high]
            slope = 0.5 * (gain[:, low] - gain[:, high])
            # top of a parabola
            shift[:, axis] = np.where(bend < 0.0, np.clip(slope / np.minimum(bend, -1e-9), -1.0, 1.0), 0.0)
        return uv_px + 0.5 * shift

    def following(self, frames: Sequence[ColourPlanes], levels: Array) -> Array:
        """Places in the image, shape (n, 2), whose light follows a code over frames of a rig that rests.

        The mean of the frames with the light on, less the mean of those with it off: nothing of the room is left.

        Parameters
        ----------
        frames : sequence of N ColourPlanes
        levels : shape (N, rows of the box)
            Of the code, by the time of each row.
        """
        x = np.clip(levels, 0.0, 1.0)
        lit, dark = x.sum(axis=0), (1.0 - x).sum(axis=0)
        if min(lit.min(), dark.min()) < 1.0:
            return np.zeros((0, 2))
        reds = np.stack([frame.values_e[0] for frame in frames])
        on, off = (
            np.einsum("nr,nrc->rc", np.asarray(weights, np.float32), reds) for weights in (x / lit, (1.0 - x) / dark)
        )
        scale = math.sqrt(0.5 * float(np.median(((x / lit) ** 2 + ((1.0 - x) / dark) ** 2).sum(axis=0))))
        first = frames[0]
        mean_on, mean_off = (replace(first, values_e=np.stack([red, red, red])) for red in (on, off))
        brighter = self._brighter(mean_on, mean_off, self.inside, scale, _LEAST_FOLLOWING)
        return self._refined(mean_on, mean_off, brighter) + self._origin

    def _brighter(
        self,
        planes: ColourPlanes,
        before: ColourPlanes,
        where: BoolArray,
        scale: float = 1.0,
        least: float = _LEAST_CHANGE,
    ) -> Array:
        """Places relative to the box, shape (n, 2), that are brighter than before; `scale` is that of the noise."""
        step = 2 if planes.mosaic else 1
        now, then = (frame.values_e[0][::step, ::step] for frame in (planes, before))
        z = (now - then) / scale / np.sqrt(2.0 * variance_e2(np.maximum(now, then), self.card, True))
        kernel = np.array([_SIDE_SHARE, 1.0, _SIDE_SHARE]) / math.sqrt(1.0 + 2.0 * _SIDE_SHARE**2)
        z = correlate1d(correlate1d(z, kernel, axis=0), kernel, axis=1) * where[::step, ::step]
        highest = np.flatnonzero((z >= _LEAST_SITE) & (z == maximum_filter(z, 3)))
        highest = highest[np.argsort(-z.ravel()[highest], kind="stable")][:_MOST_SITES]
        if not len(highest):
            return np.zeros((0, 2))
        sites = step * np.stack(np.unravel_index(highest, z.shape)[::-1], axis=-1).astype(float)
        around = (sites[:, None] + _OFFSETS).reshape(-1, 2)
        tests = candidates_at(planes, before, self.card, around, self.sigma_px)
        # without chi^2: the difference has no structure that a misfit would have to tell
        significance = (tests.electrons / tests.sigma_e).reshape(len(sites), -1) / scale
        best = significance.argmax(axis=1)
        return around.reshape(len(sites), -1, 2)[np.arange(len(sites)), best][significance.max(axis=1) >= least]

    def light(self, planes: ColourPlanes, uv_px: Array) -> tuple[Array, Array]:
        """Amplitudes at places (n, 2) and their standard deviations, electrons; NaN outside of the mirror's image."""
        at = np.asarray(uv_px, float).reshape(-1, 2) - self._origin
        inside = ((at >= 0.0) & (at <= np.array(self.inside.shape[::-1]) - 1.0)).all(axis=1)
        row, column = np.rint(np.where(inside[:, None], at, 0.0)).astype(int).T[::-1]
        inside &= self.inside[row, column]
        result = np.full((2, len(at)), np.nan)
        if inside.any():
            tests = candidates_at(planes, None, self.card, at[inside], self.sigma_px)
            # without chi^2: what does not fit is the room's structure, which is steady
            result[0, inside], result[1, inside] = tests.electrons, tests.sigma_e
        return result[0], result[1]

    def window(self, image: NDArray[Any], uv_px: Array) -> tuple[NDArray[Any], tuple[int, int]]:
        """Square of `WINDOW_PX` around a place, moved inwards at the image's edge, and its first pixel (u, v)."""
        height, width = image.shape[:2]
        u0, v0 = (
            int(np.clip(round(float(x)) - WINDOW_PX // 2, 0, n - WINDOW_PX))
            for x, n in zip(uv_px, (width, height), strict=True)
        )
        return image[v0 : v0 + WINDOW_PX, u0 : u0 + WINDOW_PX], (u0, v0)


@dataclass(eq=False)
class SpotTrack:
    """One light over frames `first` to `first` + n - 1.

    Attributes
    ----------
    uv_px : list of (u, v)
        Place by the filter: after the spot, where one was detected, otherwise as predicted.
    electrons, sigma_e : list of float
        Amplitude in every frame.
    detected : list of bool
    windows, origins_px : list
        Pixels around the spot of each frame in which it was detected.
    """

    number: int
    first: int
    motion: Any = field(repr=False)
    uv_px: list[tuple[float, float]] = field(default_factory=list)
    electrons: list[float] = field(default_factory=list)
    sigma_e: list[float] = field(default_factory=list)
    detected: list[bool] = field(default_factory=list)
    windows: list[NDArray[Any]] = field(default_factory=list, repr=False)
    origins_px: list[tuple[int, int]] = field(default_factory=list, repr=False)

    def __len__(self) -> int:
        return len(self.electrons)

    @property
    def last(self) -> int:
        """Number of the latest frame."""
        return self.first + len(self) - 1

    @property
    def frames(self) -> NDArray[np.int64]:
        """Numbers of the frames, shape (n,)."""
        return self.first + np.arange(len(self))

    @property
    def dark(self) -> int:
        """Frames since the last spot."""
        return next((k for k, seen in enumerate(reversed(self.detected)) if seen), len(self))

    @property
    def spots(self) -> int:
        """Number of frames in which it was detected."""
        return sum(self.detected)

    @property
    def place_px(self) -> tuple[float, float]:
        """Latest place."""
        return self.uv_px[-1]

    def put(self, uv_px: Sequence[float], electrons: float, sigma_e: float, detected: bool) -> None:
        """Take in a frame."""
        self.uv_px.append((float(uv_px[0]), float(uv_px[1])))
        self.electrons.append(electrons)
        self.sigma_e.append(sigma_e)
        self.detected.append(detected)

    def measured_again(self, start: int, uv_px: Array, light: Array) -> None:
        """Replace place and light of the frames from `start` to the latest; `light` has shape (2, frames)."""
        place = (float(uv_px[0]), float(uv_px[1]))
        if (more := self.first - start) > 0:
            self.first = start
            self.detected[:0] = [False] * more
        kept = start - self.first
        self.uv_px[kept:] = [place] * light.shape[1]
        self.electrons[kept:], self.sigma_e[kept:] = light[0].tolist(), light[1].tolist()


class SpotTracker:
    """Tracks of all spots of a film, frame by frame.

    Parameters
    ----------
    patience : int
        Frames without a spot after which a track ends.
    tentative : int
        The same of a track of one or two spots.
    """

    def __init__(self, search: FrameSearch, patience: int = 30, tentative: int = 6) -> None:
        self.search, self.patience, self.tentative = search, patience, tentative
        self.live: list[SpotTrack] = []
        self.frame = -1
        self._count = 0
        self._moved = False
        self._before: deque[ColourPlanes] = deque(maxlen=_KEPT)
        self._pixels: deque[NDArray[Any]] = deque(maxlen=_REMEMBERED)

    def add(self, image: NDArray[Any], moves: bool = False) -> None:
        """Take in the next frame; `moves` says that spots may have changed their speed since the frame before.

        Raises
        ------
        ValueError
            If the image does not fit the card's output.
        """
        self.frame += 1
        planes = self.search.planes(image)
        spots = self.search.spots(planes, self._before[-2] if len(self._before) > 1 else None)
        self._pixels.append(self.search.part(image).copy())
        changes = moves or self._moved
        self._moved = moves
        for track in self.live:
            track.motion.predict(Q=_MOVING * _AGILITY if changes else _AGILITY)
        expected = np.array([_place(track) for track in self.live]).reshape(-1, 2)
        taken = _assigned(self.live, expected, spots)
        for k, spot in taken.items():
            self.live[k].motion.update(spots.uv_px[spot])
        # where the filter is after the update: all frames know the place better than one, which lies on half a pixel
        places = np.array([_place(track) for track in self.live]).reshape(-1, 2)
        light = self.search.light(planes, places)
        for k, track in enumerate(self.live):
            track.put(places[k], float(light[0][k]), float(light[1][k]), k in taken)
            if k in taken:
                self._keep(track, image, spots.uv_px[taken[k]])
        self._begin(spots, sorted(set(range(len(spots))) - set(taken.values())), image)
        self._before.append(planes)
        self.live = [track for track in self.live if not self._is_over(track)]

    def _begin(self, spots: FrameSpots, new: list[int], image: NDArray[Any]) -> None:
        """New tracks, their light in the frames before measured at the same places."""
        past = list(self._before)[-_BACK:]
        before = [self.search.light(planes, spots.uv_px[new]) for planes in past] if new else []
        for k, spot in enumerate(new):
            uv = spots.uv_px[spot]
            track = SpotTrack(
                self._count, self.frame - len(before), _motion(uv, _MOVING_PX if self._moved else _SPEED_PX)
            )
            for electrons, sigma_e in before:
                track.put(uv, float(electrons[k]), float(sigma_e[k]), False)
            track.put(uv, float(spots.electrons[spot]), float(spots.sigma_e[spot]), True)
            self._keep(track, image, uv)
            self.live.append(track)
            self._count += 1

    def follow(self, levels: Array) -> dict[int, int]:
        """Tracks where the light of the latest frames follows a code; `levels` as for `FrameSearch.following`.

        A track that is there already is measured again in these frames, at the place that all of them give: on an edge
        of the room its own place may have wandered, and what it measured with it. Returned are the tracks that now
        begin earlier, and the frames in which they began before.
        """
        frames, earlier = list(self._before)[-len(levels) :], {}
        start = self.frame - len(frames) + 1
        for uv in self.search.following(frames, levels):
            near = [
                other_track
                for other_track in self.live
                if np.linalg.norm(np.array(other_track.place_px) - uv) < _SAME_PX
            ]
            light = np.concatenate([self.search.light(planes, uv) for planes in frames], axis=1)
            if near:
                for track in near:
                    if track.first > start:
                        earlier[track.number] = track.first
                    track.measured_again(start, uv, light)
                    track.motion = _motion(uv)
                continue
            track = SpotTrack(self._count, start, _motion(uv))
            for electrons, sigma_e in light.T:
                track.put(uv, float(electrons), float(sigma_e), bool(electrons > LEAST_Z * sigma_e))
            track.detected[-1] = True
            self.live.append(track)
            self._count += 1
        return earlier

    @property
    def kept(self) -> int:
        """Frames over which a code may be followed now."""
        return len(self._before)

    @property
    def planes(self) -> ColourPlanes:
        """Planes of the latest frame."""
        return self._before[-1]

    @property
    def oldest(self) -> int:
        """Number of the earliest frame whose pixels are kept."""
        return self.frame - len(self._pixels) + 1

    def pixels(self, frames: NDArray[np.int64]) -> NDArray[Any]:
        """Pixels of the box in frames from `oldest` on, shape (n, h, w, ...)."""
        return np.stack([self._pixels[int(k) - self.oldest] for k in frames])

    def _keep(self, track: SpotTrack, image: NDArray[Any], uv_px: Array) -> None:
        window, origin = self.search.window(image, uv_px)
        track.windows.append(window.copy())
        track.origins_px.append(origin)

    def _is_over(self, track: SpotTrack) -> bool:
        if not math.isfinite(track.electrons[-1]):
            return True  # it left the mirror's image
        return track.dark > (self.tentative if track.spots <= _TENTATIVE else self.patience)


def _motion(uv_px: Array, speed_px: float = _SPEED_PX) -> Any:
    """Filter of constant velocity of `filterpy`: u, its velocity, v, its velocity; pixels and frames."""
    try:
        from filterpy.kalman import KalmanFilter
    except ImportError as error:
        raise SceneError("tracks need filterpy: pip install 'phibench[loop]'") from error
    motion = KalmanFilter(4, 2)
    motion.F = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
    motion.H = np.kron(np.eye(2), [[1.0, 0.0]])
    motion.x = np.array([[uv_px[0]], [0.0], [uv_px[1]], [0.0]])
    motion.P = np.diag([_PLACE_PX**2, speed_px**2] * 2)
    motion.R = _PLACE_PX**2 * np.eye(2)
    return motion


def _place(track: SpotTrack) -> Array:
    return np.asarray(track.motion.x[[0, 2], 0])


def _assigned(tracks: Sequence[SpotTrack], expected: Array, spots: FrameSpots) -> dict[int, int]:
    """Spots by the tracks that they belong to, by global nearest neighbours within the gate."""
    if not len(tracks) or not len(spots):
        return {}
    spread = np.array([track.motion.P[np.ix_([0, 2], [0, 2])] for track in tracks]) + _PLACE_PX**2 * np.eye(2)
    apart = spots.uv_px[None] - expected[:, None]
    distance2 = np.einsum("tsi,tij,tsj->ts", apart, np.linalg.inv(spread), apart)
    # a wide gate must not win against a narrow one: the logarithm of the likelihood, not the distance alone
    cost = distance2 + np.log(np.linalg.det(spread))[:, None]
    near: BoolArray = (distance2 < _GATE2) & (np.linalg.norm(apart, axis=-1) < _FARTHEST_PX)
    # 1e6: beyond the gate, never chosen
    rows, columns = linear_sum_assignment(np.where(near, cost - cost.min() + 1.0, 1e6))
    good = near[rows, columns]
    return dict(zip(rows[good].tolist(), columns[good].tolist(), strict=True))


def fitted_positions(track: SpotTrack, rig: Rig, card: SensorCard, depth_m: float = 2.5) -> FilmPositions:
    """Positions in the frames in which a track's spot was detected and its pixels kept, with their covariance.

    The fixed pattern counts as new in every frame, and the room as a level per filter. Raw pixels only.

    Raises
    ------
    SceneError
        If the pixels are not raw.
    """
    if card.output != "raw":
        raise SceneError(f"positions of '{card.output}' frames have no fit for films; take raw ones")
    blur = spot_blur(rig, np.array(track.place_px), depth_m, Beam())
    x = raw_electrons(np.stack(track.windows), card)
    red, green, blue = rig.camera.detector.laser_filter_response
    model = SpotModel((red, green, blue) if card.mosaic == "bayer" else None)
    regions = spot_regions(x, track.origins_px, x < card.full_from_e)
    fit = fit_law(regions, GaussLaw(noise_of(card, pattern_known=False)), blur, model)
    good = (fit.status == Status.OK)[:, None]
    # what the room's edges do to a spot shows in the misfit
    covariance = fit.covariance_px2 * np.maximum(fit.chi2, 1.0)[:, None, None]
    count = len(x)
    return FilmPositions(np.where(good, fit.uv_px, np.nan), covariance, np.zeros((count, 2, count, 2)))
