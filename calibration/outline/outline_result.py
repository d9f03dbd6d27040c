"""Outline of a mirror in an image, as it was found: place, covariance, quality; and what all fits of outlines share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.calibration.outline.ball_circle import BallCircle
from phibench.calibration.outline.edge_ring import TURNS
from phibench.calibration.outline.limb_image import JPEG_LUMA, Plane, PoseMeasurement
from phibench.calibration.outline.outline_fit import OutlinePixels, Step
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.camera_codes import light_of, mcu_px, tone_of
from phibench.estimator.spots.image_planes import ImageError, full_scale_e, through_jpeg
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, BoolArray, as_vector
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig

SECTORS = 120  # three degrees, some 18 px of the limb
JPEG_DRAWS = (2, 8)
"""Draws of noise and JPEG from which the change of an outline by JPEG is taken, in a first and a second round."""
_BESIDE_LAMP_PX, _FEWEST_FULL = 4.0, 2  # pixels on both sides of an outline, and of 9 places there
_SHARED = 0.55  # of the scatter, and the scatter from which on it counts: measured in 60 rooms, see `shared_px2`
_SMOOTH, _SMOOTH_JPEG = 2.5, 10.0
_FROM_EDGE_PX = 1.0  # the steepest place of the light is some tenths of a pixel inside the limb


@dataclass(frozen=True)
class Outline:
    """Mirror from an outline, with its quality.

    Attributes
    ----------
    sphere_in_camera_m : shape (3,)
        Centre of a sphere; vertex of a mirror of revolution, for the tilt that the rig says.
    covariance_m2 : shape (3, 3)
        For exact radius, or profile and tilt, and camera.
    arc : float
        Part of the outline that was used.
    contrast : float
        Fall of the light inside the limb over what the steel's reflectance gives; 1 for this mirror.
    blur_px : float
        Standard deviation of the lens's blur that was found.
    residual : float
        Robust standard deviation of the residuals over the light.
    pixels, steps : int
        Squares of pixels in long pictures.
    by_edge : bool
        The light is not as the model has it: the outline is the edge in the picture. Contrast, blur and residual are
        NaN.
    shifts_px : shape (SECTORS,)
        Shift of the limb that the fit leaves in each sector, outwards positive, pixels; NaN where it is not used.
        Sector k begins at the angle -pi + 2 pi k / SECTORS about the mirror's direction, from the camera's x to y.
    ellipse_px : (e1, e2) or None
        What the outline of a mirror of revolution has besides, outwards: e1 cos 2t + e2 sin 2t at the turn t in the
        image. A tilt of the mirror gives them, in its second order. None for a sphere.
    covariance : shape (5, 5) or None
        Of vertex and ellipse, metres and pixels.
    """

    sphere_in_camera_m: Array
    covariance_m2: Array = field(repr=False)
    arc: float
    contrast: float
    blur_px: float
    residual: float
    pixels: int
    steps: int
    shifts_px: Array = field(default_factory=lambda: np.zeros(SECTORS), repr=False)
    by_edge: bool = False
    ellipse_px: tuple[float, float] | None = None
    covariance: Array | None = field(default=None, repr=False)

    @property
    def sigma_m(self) -> Array:
        """Standard deviations of s, shape (3,)."""
        return np.sqrt(np.diag(self.covariance_m2))

    @property
    def shift_rms_px(self) -> float:
        """Root mean square of the sectors' shifts."""
        return float(np.sqrt(np.nanmean(np.square(self.shifts_px))))

    def widened(self, factor: float) -> Outline:
        """The same with a standard deviation `factor` times as large.

        Raises
        ------
        ImageError
            If the factor is not above 0.
        """
        if not 0.0 < factor < np.inf:
            raise ImageError(f"the factor of the outline's standard deviation is {factor:g}: it must be above 0")
        wider = None if self.covariance is None else self.covariance * factor**2
        return replace(self, covariance_m2=self.covariance_m2 * factor**2, covariance=wider)

    @property
    def measured(self) -> PoseMeasurement:
        """Data of a bundle: the sphere's centre, shape (3,), or vertex and ellipse, shape (5,)."""
        if self.ellipse_px is None or self.covariance is None:
            return PoseMeasurement(self.sphere_in_camera_m, self.covariance_m2)
        return PoseMeasurement(np.concatenate([self.sphere_in_camera_m, self.ellipse_px]), self.covariance)

    def rig(self, nominal: Rig) -> Rig:
        """The nominal rig with the mirror where its outline is, turned as the nominal one is."""
        pose = replace(nominal.T_camera_sphere, translation_m=as_vector(self.sphere_in_camera_m))
        return replace(nominal, T_camera_sphere=pose)


def mean_outline(outlines: Sequence[Outline]) -> PoseMeasurement:
    """Weighted mean of what outlines measure, see `mean_measured`."""
    return mean_measured([outline.measured for outline in outlines])


def mean_measured(parts: Sequence[PoseMeasurement]) -> PoseMeasurement:
    """Weighted mean of vectors; their scatter widens the covariance where it is larger than they claim."""
    weights = np.array([np.linalg.inv(measurement.covariance) for measurement in parts])
    covariance = np.linalg.inv(weights.sum(axis=0))
    values = np.array([measurement.value for measurement in parts])
    mean = covariance @ np.einsum("kij,kj->i", weights, values)
    off = values - mean
    degrees = values.shape[1] * (len(parts) - 1)
    chi2 = float(np.einsum("ki,kij,kj->", off, weights, off))
    return PoseMeasurement(mean, covariance * max(1.0, chi2 / degrees if degrees else 1.0))


# -- what mirrors of all shapes have for the fit -----------------------------------------------------------------------

MIN_ARC = 0.5
"""Part of the outline that must lie in the image."""


@dataclass(frozen=True)
class MirrorOutline:
    """Outline of a rig's mirror at a place, for the fit of `outline`: what all shapes have.

    Attributes
    ----------
    planes : of the image
    rig : Rig
        Nominal.
    place : shape (3,) or (5,)
        Centre or vertex in the camera frame, metres; then what the outline has besides, pixels.
    """

    planes: tuple[Plane, ...]
    rig: Rig
    place: Array

    def visible_part(self, outline_px: Array, margin_px: float) -> float:
        """Part of an outline, of which points (n, 2) are given, that lies `margin_px` inside the image's border."""
        camera = self.rig.camera
        low, high = margin_px - 0.5, np.array([camera.width_px, camera.height_px]) - 0.5 - margin_px
        return float(np.mean(np.all((outline_px >= low) & (outline_px <= high), axis=-1)))


@dataclass(frozen=True)
class OutlineStart:
    """Circle in a picture that may be the mirror's outline, the edge near it, and the place of such an outline."""

    place: Array
    circle: BallCircle
    edge: BallCircle


# -- what fits of outlines share ---------------------------------------------------------------------------------------


def require_size(image: Array, camera: Camera) -> None:
    """Raise `ImageError` for a frame of another camera."""
    if image.shape != (camera.height_px, camera.width_px):
        raise ImageError(
            f"an image of {image.shape[1]} x {image.shape[0]} pixels for a camera of {camera.width_px} x "
            f"{camera.height_px}: give a whole frame of this camera"
        )


def binned_rig(rig: Rig, block: int) -> Rig:
    """Rig whose pixels are squares of `block` of the camera's."""
    camera = rig.camera
    lengths = {name: getattr(camera, name) / block for name in ("fx_px", "fy_px", "blur_sigma_px")}
    centre = {name: (getattr(camera, name) + 0.5) / block - 0.5 for name in ("cx_px", "cy_px")}
    size = {name: getattr(camera, name) // block for name in ("width_px", "height_px")}
    return replace(
        rig, camera=replace(camera, pixel_pitch_um=camera.pixel_pitch_um * block, **size, **lengths, **centre)
    )


def edge_shifts_px(circle: BallCircle) -> Array:
    """Mean distance of the edges from a circle in each sector, shape (SECTORS,); NaN in one without an edge."""
    off = np.roll(circle.off_px, TURNS // 2).reshape(SECTORS, -1)
    seen = np.isfinite(off)
    return np.where(seen.any(axis=1), np.nansum(off, axis=1) / np.maximum(seen.sum(axis=1), 1), np.nan)


def require_near(rig: Rig, circle: BallCircle) -> None:
    """Raise `ImageError` if a fit of the light has left the edge that it began at."""
    u, v, _ = circle.circle_px
    outline, edge = rig.outline_px(TURNS) - (u, v), circle.points_px - (u, v)
    turn, order = np.arctan2(edge[:, 1], edge[:, 0]), np.argsort(np.arctan2(edge[:, 1], edge[:, 0]))
    there = np.interp(
        np.arctan2(outline[:, 1], outline[:, 0]), turn[order], np.hypot(*edge.T)[order], period=2.0 * np.pi
    )
    off = float(np.abs(np.hypot(*outline.T) - there).max())
    allowed = _FROM_EDGE_PX + 3.0 * float(circle.sigma_px.max())
    if off > allowed:
        raise ImageError(
            f"an image without a mirror: the light of polished steel fits best {off:.1f} px from the edge that is "
            f"there; {allowed:.1f} px are allowed"
        )


def require_unlit(full: BoolArray, outline_px: Array, most: float) -> None:
    """Raise `ImageError` if more than a part of an outline, shape (n, 2), lies beside full pixels.

    A lamp in the mirror fills the pixels that its blur reaches: before a dark plate the edge of what is full lies some
    pixels outside the limb, and that of a lamp all along the limb as many inside.
    """
    middle = outline_px.mean(axis=0)
    away = outline_px - middle
    reach = 1.0 + _BESIDE_LAMP_PX * np.linspace(-1.0, 1.0, 9) / np.linalg.norm(away, axis=1)[:, None]
    u, v = (np.rint(middle[k] + reach * away[:, k, None]).astype(np.intp) for k in (0, 1))
    seen = (u >= 0) & (v >= 0) & (u < full.shape[1]) & (v < full.shape[0])
    lit = (full[np.clip(v, 0, full.shape[0] - 1), np.clip(u, 0, full.shape[1] - 1)] & seen).sum(axis=1) >= _FEWEST_FULL
    share = float(lit[seen.any(axis=1)].mean()) if seen.any() else 0.0
    if share > most:
        raise ImageError(
            f"lamps fill the pixels along {100.0 * share:.0f} % of the mirror's outline: where the limb is cannot be "
            "seen there; take the picture with a shorter exposure, or switch lamps off"
        )


def shared_px2(shifts_px: Array, scatter: float, jpeg: bool) -> float:
    """Variance of centre and radius by what errs alike in all sectors, which their scatter does not show.

    The edges of a room lie at one height all around. The share of the sectors' scatter was measured in 60 rooms; a
    scatter of a few times the pixels' noise is JPEG's, and of rooms without edges.
    """
    usual = 1.4826 * float(np.nanmedian(np.abs(shifts_px)))  # that of a normal law
    return float((_SHARED * usual) ** 2 * max(1.0 - (_SMOOTH_JPEG if jpeg else _SMOOTH) / scatter, 0.0))


# -- JPEG --------------------------------------------------------------------------------------------------------------

# JPEG removes the limb's fine waves. The limb becomes wider and moves, by an amount that depends on the quality, on the
# limb's place in the blocks, and on the noise. The fit's own model is known exactly. It goes through the camera's noise
# and the same compression, in the same blocks; the fit then errs by about the same. Luma blocks are independent of each
# other, so that only the units around the outline are compressed.

_ROW = 40  # units side by side in the picture that is compressed


@dataclass(frozen=True)
class Units:
    """The units of a frame that some pixels lie in, with a border of 1 px.

    Attributes
    ----------
    u, v : shape (T, h + 2, w + 2)
        Pixels; beyond the frame its border's.
    place : shape (N,)
        Number of each pixel in the packed picture, flat.
    rows : int
        Units that are one above the other in the packed picture.
    """

    u: NDArray[np.int64]
    v: NDArray[np.int64]
    place: NDArray[np.int64]
    rows: int


def units_of(pixels: OutlinePixels, size: tuple[int, int], subsampling: str) -> Units:
    """Units of the pixels, for a frame of `size` (height, width)."""
    h, w = mcu_px(subsampling)
    unit, number = np.unique((pixels.v // h) * size[1] + pixels.u // w, return_inverse=True)
    y, x = np.mgrid[-1 : h + 1, -1 : w + 1]
    v = np.clip((unit // size[1] * h)[:, None, None] + y, 0, size[0] - 1)
    u = np.clip((unit % size[1] * w)[:, None, None] + x, 0, size[1] - 1)
    row, column = np.divmod(number, _ROW)
    place = (row * h + pixels.v % h) * (_ROW * w) + column * w + pixels.u % w
    return Units(u, v, place, -(-len(unit) // _ROW))


@dataclass(frozen=True)
class JpegAgain:
    """A frame's processing, ready for other light in the pixels around an outline.

    Parameters
    ----------
    frame : shape (H, W, 3), 8 bits
    pixels : OutlinePixels
    card : SensorCard
    """

    frame: NDArray[Any]
    pixels: OutlinePixels
    card: SensorCard

    def drawn(self, model: Array, draws: int) -> Array:
        """Light of the pixels, shape (draws, N), as the fit would see it if its model, shape (N,), were true."""
        units = units_of(self.pixels, (self.frame.shape[0], self.frame.shape[1]), self.card.jpeg_subsampling)
        factor = np.ones(self.frame.shape[:2])
        with np.errstate(all="ignore"):
            # pixels next to black: their ratio says nothing
            factor[self.pixels.v, self.pixels.u] = np.clip(np.nan_to_num(model / self.pixels.y, nan=1.0), 0.25, 4.0)
        linear = light_of(self.frame[units.v, units.u] / 255.0, self.card) * factor[units.v, units.u][..., None]
        return np.array([self._seen(units, linear, k) for k in range(draws)])

    def _seen(self, units: Units, linear: Array, draw: int) -> Array:
        rng = generator("calibration", "outline_jpeg", draw)
        light = linear[:, 1:-1, 1:-1] + _noise(linear, units, self.card, rng)
        codes = np.rint(255.0 * tone_of(light, self.card)).astype(np.uint8)
        image = through_jpeg(_packed(codes, units.rows), self.card)
        decoded = light_of(image.reshape(-1, 3)[units.place] / 255.0, self.card)
        return np.asarray(decoded @ np.array(JPEG_LUMA) / self.pixels.ray[:, 2] ** 4)


def _noise(linear: Array, units: Units, card: SensorCard, rng: np.random.Generator) -> Array:
    """Noise of demosaiced linear light, shape (T, h, w, 3), for the light (T, h + 2, w + 2, 3) of units and border."""
    gain = np.asarray(card.white_balance) / full_scale_e(card)
    colour = np.broadcast_to(np.arange(3), linear.shape)
    du, dv = card.mosaic_phase
    own = (
        colour == ((units.v + dv) % 2 + (units.u + du) % 2)[..., None]
        if card.mosaic == "bayer"
        else np.ones(linear.shape, bool)
    )
    electrons = np.clip(linear, 0.0, None) / gain
    variance = card.read_noise_e**2 + card.dsnu_e**2 + (card.prnu * electrons) ** 2 + 1.0 / (12.0 * card.dn_per_e**2)
    if card.shot_noise:
        variance = variance + electrons
    noise = np.where(own, rng.standard_normal(linear.shape) * np.sqrt(variance), 0.0) * gain
    if card.mosaic != "bayer":
        return noise[:, 1:-1, 1:-1]
    beside = noise[:, 1:-1, :-2] + noise[:, 1:-1, 2:] + noise[:, :-2, 1:-1] + noise[:, 2:, 1:-1]
    corners = noise[:, :-2, :-2] + noise[:, :-2, 2:] + noise[:, 2:, :-2] + noise[:, 2:, 2:]
    weights = np.where(np.arange(3) == 1, 0.25, 0.5)  # green has a neighbour on each side, red and blue on two
    return np.asarray(noise[:, 1:-1, 1:-1] + weights * beside + np.array([0.25, 0.0, 0.25]) * corners)


def _packed(codes: NDArray[np.uint8], rows: int) -> NDArray[np.uint8]:
    """Units (T, h, w, 3) side by side; what is left of the last row is mid grey."""
    T, h, w, _ = codes.shape
    whole = np.full((rows * _ROW, h, w, 3), 128, np.uint8)
    whole[:T] = codes
    return whole.reshape(rows, _ROW, h, w, 3).transpose(0, 2, 1, 3, 4).reshape(rows * h, _ROW * w, 3)


def without_jpeg(pixels: OutlinePixels, step: Step, frame: NDArray[Any], card: SensorCard) -> tuple[Array, Array]:
    """Last step of the fit of a JPEG frame, shape (4,), and its covariance, less what JPEG does to the fit.

    The model of the light is drawn through the camera's noise and JPEG, and the fit's answer compared with what was
    put in: first with the blur that was found, which JPEG has made wider, then with the blur that this leaves.
    """
    again, change = JpegAgain(frame, pixels, card), step.move
    for draws in JPEG_DRAWS:
        off = np.mean(again.drawn(step.model + step.by_parameters @ change, draws), axis=0) - step.model
        change = step.move - (step.solution.move(off) - change)
    # the draws' own mean is left in the scatter: what is large there was not drawn from quite the true light
    return change, step.solution.covariance(pixels.y - step.model)
