"""Result of an outline fit (`Outline`), means of several, test for a moved mirror; base class and checks of fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from phibench.calibration.outline.ball_circle import BallCircle
from phibench.calibration.outline.edge_ring import TURNS
from phibench.calibration.outline.limb_image import Plane
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, BoolArray, as_vector
from phibench.scenes.rig import Rig

SECTORS = 120  # three degrees, some 18 px of the limb
JPEG_DRAWS = (2, 8)
"""Draws of noise and JPEG from which the change of an outline by JPEG is taken, in a first and a second round."""
_BESIDE_LAMP_PX, _FEWEST_FULL = 4.0, 2  # pixels on both sides of an outline, and of 9 places there
_SHARED = 0.55  # of the scatter, and the scatter from which on it counts: measured in 60 rooms, see `shared_px2`
_SMOOTH, _SMOOTH_JPEG = 2.5, 10.0
_FROM_EDGE_PX = 1.0  # the steepest place of the light is some tenths of a pixel inside the limb


@dataclass(frozen=True)
class PoseMeasurement:
    """A sphere centre or a vertical that was measured, with its covariance."""

    value: Array
    covariance: Array


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


_MOVED_SIGMAS = 5.0  # of one outline against another: 1e-5 of rigs that did not move are further off
_GROWN = 0.003  # of the outline's size: one rig's outlines in ten rooms differ by less


def outlines_as_one(outlines: Sequence[Outline]) -> PoseMeasurement:
    """Weighted mean of outlines of one rig, with the covariance of a single one.

    What an outline claims is mostly what all of them share: the lens's blur, where the limb lies in its edge, the
    nominal camera. Ten outlines of a rig in ten rooms were all 0.4 to 0.6 mm short, each within its sigma.
    """
    mean = mean_outline(outlines)
    return replace(mean, covariance=mean.covariance * len(outlines))


def mirror_moved(then: PoseMeasurement, now: PoseMeasurement) -> str:
    """Words on a mirror that is not where it was, or not as large; "" for one that is."""
    covariance = now.covariance + then.covariance
    across = (now.value - then.value)[:2]
    off = float(np.sqrt(across @ np.linalg.solve(covariance[:2, :2], across)))
    if off > _MOVED_SIGMAS:
        return f"the mirror has moved by {1e3 * float(np.linalg.norm(across)):.2f} mm ({off:.0f} sigma)"
    grown, sigma = (then.value - now.value)[2] / now.value[2], float(np.sqrt(covariance[2, 2])) / now.value[2]
    if abs(grown) <= max(_GROWN, _MOVED_SIGMAS * sigma):
        return ""
    size = "larger" if grown > 0.0 else "smaller"
    return (
        f"the mirror's outline became {100.0 * abs(grown):.1f} % {size} (the lens was refocused, or the mirror moved "
        "along the axis)"
    )


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
