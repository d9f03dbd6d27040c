"""Targets without a blink code: the nearest bright red blob, and identification by colour. Baselines.

`NearestBlob` is what one writes first. It takes the brightest red blob of the first frame, and from then on the blob
that is nearest to its last place. It asks nothing of time, so that it says something from the first frame on, and never
that it does not know.

`ColourIdentity` knows the target by its colour. A laser's wavelength passes the filters in known shares
(`detector.laser_filter_response`). For every track, amplitudes behind each filter are averaged over the frames in which
it was seen. A track has the colour if its green and blue differ from the laser's shares of red by no more than chance
allows, and if they are known well enough to tell: white light has more green by far. The brightest such track is the
target. Other lasers of the wavelength, and reflections of the target, have the same colour: nothing tells them apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.candidates import _PATCH_REACH_PX, _fitted, _template
from phibench.estimator.spots.image_planes import ColourPlanes, green_at_red
from phibench.robot.film.spot_tracks import FrameSearch, SpotTrack
from phibench.scenes.frames import Array
from phibench.scenes.validation import SceneError

_BLOB_SITES, _AROUND_SITES = 3, 9  # squares of red sites: a spot of 0.9 px lies in the first
_LEAST_BLOB = 6.0  # of the image's own spread
_WITHIN_PX = 12.0  # of a blob from where it was
_GIVEN_UP = 10  # frames without a blob there, after which the brightest one is taken again


def plane_amplitudes(on: ColourPlanes, card: SensorCard, uv_px: Array, sigma_px: float) -> tuple[Array, Array]:
    """Amplitudes in every plane, each by itself, and their variances, electrons: shape (c, n) each."""
    reach = _PATCH_REACH_PX[on.mosaic]
    corner = np.rint(uv_px).astype(int) - reach
    template = _template(uv_px - corner, sigma_px, reach)
    fits = [_fitted(on, None, card, c, corner, template, guided=False) for c in range(len(on.values_e))]
    return np.stack([f.amplitude for f in fits]), np.stack([f.variance * np.maximum(f.chi2, 1.0) for f in fits])


def red_blobs(planes: ColourPlanes, search: FrameSearch) -> Array:
    """Places of red blobs in the image, the brightest first, shape (n, 2).

    A blob is a maximum of red less green, in a square of three red sites, above the square of nine around it.
    """
    step = 2 if planes.mosaic else 1
    red = planes.values_e[0] - (green_at_red(planes) if len(planes.values_e) > 1 else 0.0)
    red = np.asarray(red[::step, ::step], np.float32)
    blob = uniform_filter(red, _BLOB_SITES) - uniform_filter(red, _AROUND_SITES)
    inside = search.inside[::step, ::step]
    spread = 1.4826 * float(np.median(np.abs(blob[inside])))
    v, u = np.nonzero(inside & (blob == maximum_filter(blob, _BLOB_SITES)) & (blob > _LEAST_BLOB * spread))
    order = np.argsort(-blob[v, u], kind="stable")
    return step * np.stack([u, v], axis=-1)[order] + np.array([search.box.u0_px, search.box.v0_px], float)


class NearestBlob:
    """Place of a target by a rule of thumb, frame by frame.

    Parameters
    ----------
    place_px : shape (2,), optional
        Where the target is, if that is known at first.

    Attributes
    ----------
    place_px : shape (2,), or None
        Latest place; None before the first blob.
    """

    def __init__(self, place_px: Array | None = None) -> None:
        self.place_px = place_px
        self._without = 0

    def add(self, blobs_px: Array) -> None:
        """Take in the blobs of a frame, the brightest first, shape (n, 2)."""
        if self.place_px is None or self._without >= _GIVEN_UP:
            if len(blobs_px):
                self.place_px, self._without = blobs_px[0], 0
            return
        apart = np.linalg.norm(blobs_px - self.place_px, axis=1)
        if len(apart) and apart.min() <= _WITHIN_PX:
            self.place_px, self._without = blobs_px[int(apart.argmin())], 0
        else:
            self._without += 1


# -- colour ------------------------------------------------------------------------------------------------------------

_LEAST_SEEN = 3  # frames
_LEAST_SNR = 10.0  # of the mean red amplitude
_SHARE_SIGMA = 0.06  # of green over red: between the laser's 0.1 and a red object's 0.3 lie three of them
_SAME = 9.2  # chi squared of green and blue: 1 % of lasers are beyond
_SHAPE = 0.03  # of a plane's amplitude: what blur and the mosaic leave unknown of it


@dataclass
class _Colour:
    """Sums over frames of one track: amplitudes and variances of the planes, shape (3,) each, and the frames."""

    amplitude: Array
    variance: Array
    frames: int = 0


class ColourIdentity:
    """Target among tracks by the colour of its laser.

    Parameters
    ----------
    search : FrameSearch
    response : sequence of three floats
        Shares of the laser behind red, green and blue, `detector.laser_filter_response`.

    Raises
    ------
    SceneError
        If the camera has no colours.
    """

    def __init__(self, search: FrameSearch, response: Sequence[float]) -> None:
        if search.card.mosaic != "bayer":
            raise SceneError("a target is known by its colour in colour images only; take a preset with a Bayer mosaic")
        self.search = search
        self._share = np.array(response[1:]) / response[0]
        self._seen: dict[int, _Colour] = {}

    def add(self, planes: ColourPlanes, tracks: Sequence[SpotTrack]) -> None:
        """Take in a frame, after its spots went to tracks."""
        seen = [track for track in tracks if track.detected[-1]]
        if not seen:
            return
        origin = np.array([self.search.box.u0_px, self.search.box.v0_px], float)
        places = np.array([track.place_px for track in seen]) - origin
        amplitude, variance = plane_amplitudes(planes, self.search.card, places, self.search.sigma_px)
        for k, track in enumerate(seen):
            one = self._seen.setdefault(track.number, _Colour(np.zeros(3), np.zeros(3)))
            one.amplitude, one.variance = one.amplitude + amplitude[:, k], one.variance + variance[:, k]
            one.frames += 1

    def has_colour(self, track: SpotTrack) -> bool:
        """Colour of a track is that of the laser, as far as it is known."""
        one = self._seen.get(track.number)
        if one is None or one.frames < _LEAST_SEEN or one.amplitude[0] < _LEAST_SNR * np.sqrt(one.variance[0]):
            return False
        red, rest = one.amplitude[0], one.amplitude[1:]
        variance = one.variance[1:] + self._share**2 * one.variance[0] + (_SHAPE * red) ** 2
        chi2 = float(np.sum((rest - self._share * red) ** 2 / variance))
        return bool(np.sqrt(variance[0]) < _SHARE_SIGMA * red and chi2 < _SAME)

    def target(self, tracks: Sequence[SpotTrack]) -> SpotTrack | None:
        """Brightest track, by its mean over the frames in which it was seen, that has the colour; None without one."""
        alike = [track for track in tracks if self.has_colour(track)]
        return max(alike, key=lambda track: self._mean_e(track), default=None)

    def _mean_e(self, track: SpotTrack) -> float:
        one = self._seen[track.number]
        return float(one.amplitude[0]) / one.frames
