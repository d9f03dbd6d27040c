"""Camera as a thin lens with OpenCV intrinsics and Brown distortion; its detector: electrons per joule by filter.

A point of the plane of focus has one image for the whole aperture, at the pixel that `Camera.project` gives for it.
The chief ray goes through the lens centre undeviated. The natural (cos^4) fall-off follows from this geometry and is
part of every layer.

A layer holds one plane per colour filter. Ambient light is carried in three bands, one per filter. Each band has an
effective wavelength and an efficiency: quantum efficiency times transmission of filter and lens. The laser line is
handled at its own wavelength. Nobody has published electron-level data of a C310: the numbers are assumed
(docs/model.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.validation import SceneError, finite, finite_vector, positive, within

PLANCK_J_S = 6.62607015e-34  # exact by definition of the SI
LIGHT_M_S = 299792458.0  # exact by definition of the metre
FILTERS = ("R", "G", "B")


@dataclass(frozen=True)
class Detector:
    """Photo-electrons per joule, per colour filter.

    Parameters
    ----------
    band_wavelength_nm : 3 floats
        Effective wavelength of the ambient band that each filter (R, G, B) passes.
    band_efficiency : 3 floats in [0, 1]
        Electrons per ambient photon of the own band, lens and filter included.
    laser_efficiency : float in [0, 1]
        Electrons per laser photon (650 nm) behind the red filter: quantum efficiency x filter.
    laser_filter_response : 3 floats in [0, 1]
        Response of R, G, B at the laser line, relative to the red filter.
    """

    band_wavelength_nm: tuple[float, ...] = (610.0, 540.0, 460.0)
    band_efficiency: tuple[float, ...] = (0.35, 0.40, 0.35)
    laser_efficiency: float = 0.35
    laser_filter_response: tuple[float, ...] = (1.0, 0.10, 0.03)

    def __post_init__(self) -> None:
        within("Detector", "laser_efficiency", self.laser_efficiency, 0.0, 1.0)
        for name, low, high in (
            ("band_wavelength_nm", 400.0, 700.0),
            ("band_efficiency", 0.0, 1.0),
            ("laser_filter_response", 0.0, 1.0),
        ):
            values = finite_vector("Detector", name, getattr(self, name), 3)
            for value in values:
                within("Detector", name, value, low, high)
            object.__setattr__(self, name, values)

    def laser_electrons_per_joule(self, wavelength_nm: float) -> tuple[float, ...]:
        """Expected electrons per joule of laser light on a pixel, for the filters R, G, B."""
        electrons = self.laser_efficiency * photons_per_joule(wavelength_nm)
        return tuple(electrons * response for response in self.laser_filter_response)

    def band_electrons_per_joule(self) -> tuple[float, ...]:
        """Expected electrons per joule of ambient band light on a pixel, for the filters R, G, B."""
        pairs = zip(self.band_efficiency, self.band_wavelength_nm, strict=True)
        return tuple(efficiency * photons_per_joule(nm) for efficiency, nm in pairs)


def refocused(camera: Camera, focus_distance_m: float) -> Camera:
    """The same lens turned until it is focused at another distance.

    A thin lens: its image lies at v = fx x pitch, and 1/v + 1/focus_distance is one over its focal length. So fx and fy
    grow as the plane of focus comes nearer. The aperture stays; the f-number grows with fx.

    Raises
    ------
    SceneError
        If the distance is not beyond the lens's focal length.
    """
    image_m = camera.fx_px * camera.pixel_pitch_um * 1e-6
    per_lens_m = 1.0 / image_m + 1.0 / camera.focus_distance_m
    if not focus_distance_m * per_lens_m > 1.0:
        raise SceneError(
            f"focus_distance_m {focus_distance_m:g}: must be above {1.0 / per_lens_m:.4g} m, the lens's focal length"
        )
    times = 1.0 / ((per_lens_m - 1.0 / focus_distance_m) * image_m)
    return replace(
        camera,
        fx_px=camera.fx_px * times,
        fy_px=camera.fy_px * times,
        f_number=camera.f_number * times,
        focus_distance_m=focus_distance_m,
    )


def photons_per_joule(wavelength_nm: float) -> float:
    """Photons in one joule of light of the given vacuum wavelength: lambda / (h c)."""
    return wavelength_nm * 1e-9 / (PLANCK_J_S * LIGHT_M_S)


LARGEST_SIDE_PX = 20_000  # of an image: a layer of that square would take 10 GB
_NEWTON_STEPS = 30  # at most: the loop ends with steps below the tolerance
_FOLD_MARGIN_PX = 10.0  # the blur reaches so far beyond the image
_NEWTON_TOLERANCE = 1e-14  # normalised image coordinates; 1.4e-11 px


@dataclass(frozen=True)
class Camera:
    """Intrinsics, lens and detector of one camera.

    Parameters
    ----------
    width_px, height_px : int
        Image size; pixel centres are integers, the image spans [-0.5, W - 0.5].
    pixel_pitch_um : float
        Distance of pixel centres.
    fx_px, fy_px, cx_px, cy_px : float
        OpenCV camera matrix, pixels.
    k1, k2, k3, p1, p2 : float
        Brown distortion in OpenCV's definition.
    f_number : float
        Aperture diameter = fx_px * pixel_pitch / f_number.
    focus_distance_m : float
        Distance of the plane of focus from the lens centre, along the optical axis.
    blur_sigma_px : float
        Gaussian optical blur besides defocus, pixels.
    """

    width_px: int = 1280
    height_px: int = 720
    pixel_pitch_um: float = 2.8
    fx_px: float = 1430.0
    fy_px: float = 1430.0
    cx_px: float = 639.5
    cy_px: float = 359.5
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    f_number: float = 2.4
    focus_distance_m: float = 0.23
    blur_sigma_px: float = 0.7
    detector: Detector = field(default_factory=Detector)

    def __post_init__(self) -> None:
        for name in ("width_px", "height_px", "pixel_pitch_um", "fx_px", "fy_px", "f_number", "focus_distance_m"):
            positive("Camera", name, getattr(self, name))
        for name in ("width_px", "height_px"):
            within("Camera", name, getattr(self, name), 1, LARGEST_SIDE_PX)
        for name in ("cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2"):
            finite("Camera", name, getattr(self, name))
        # narrower than 0.05 px a pixel sees no blur at all
        within("Camera", "blur_sigma_px", self.blur_sigma_px, 0.05, 20.0)
        if any((self.k1, self.k2, self.k3, self.p1, self.p2)):
            self._check_one_to_one()

    @property
    def aperture_radius_m(self) -> float:
        """Radius of the lens aperture, metres."""
        return self.fx_px * self.pixel_pitch_um * 1e-6 / (2.0 * self.f_number)

    def distort(self, xy: Array) -> Array:
        """Apply Brown distortion to normalised coordinates, shape (..., 2)."""
        return _pairs(*self._distorted(xy[..., 0], xy[..., 1]))

    def distort_jacobian(self, xy: Array) -> Array:
        """Derivative of `distort`, shape (..., 2, 2): rows (xd, yd), columns (x, y)."""
        xx, cross, yy = self._slopes(xy[..., 0], xy[..., 1])
        J = np.empty((*xy.shape, 2), dtype=xx.dtype)
        J[..., 0, 0], J[..., 0, 1], J[..., 1, 0], J[..., 1, 1] = xx, cross, cross, yy
        return J

    def _distorted(self, x: Array, y: Array) -> tuple[Array, Array]:
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        xd = x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x)
        yd = y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y
        return xd, yd

    def _slopes(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Derivatives d xd / dx, d xd / dy = d yd / dx and d yd / dy: the distortion is a gradient."""
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2.0 * (self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3))  # (d radial / d r2) * 2
        cross = x * y * slope + 2.0 * (self.p1 * x + self.p2 * y)
        xx = radial + x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x
        yy = radial + y * y * slope + 6.0 * self.p1 * y + 2.0 * self.p2 * x
        return xx, cross, yy

    def to_pixel(self, xy: Array) -> Array:
        """Pixel coordinates (u, v), shape (..., 2), of undistorted normalised coordinates (x/z, y/z)."""
        xyd = self.distort(xy)
        return xyd * np.array([self.fx_px, self.fy_px]) + np.array([self.cx_px, self.cy_px])

    def project(self, points_camera_m: Array) -> Array:
        """Pixel (u, v), shape (..., 2), of points in the camera frame, shape (..., 3); NaN behind the camera."""
        points = np.asarray(points_camera_m, float)
        z = np.where(points[..., 2:] > 0.0, points[..., 2:], np.nan)
        return self.to_pixel(points[..., :2] / z)

    def normalised(self, uv_px: Array) -> Array:
        """Undistorted normalised coordinates (x/z, y/z), shape (..., 2), of pixels (u, v), by Newton's method.

        NaN where the iteration does not converge (outside the monotonic range of the distortion polynomial).
        """
        uv = np.asarray(uv_px, float)
        # distorted coordinates; without distortion they are the answer
        target = (uv - np.array([self.cx_px, self.cy_px])) / np.array([self.fx_px, self.fy_px])
        if not any((self.k1, self.k2, self.k3, self.p1, self.p2)):
            return target
        # planes of their own: those of pairs take twice as long
        x_to, y_to = (target[..., k].copy() for k in (0, 1))
        x, y = x_to, y_to
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                (a, b, d), (xd, yd) = self._slopes(x, y), self._distorted(x, y)
                # Cramer's rule; singular: a division by 0 that shows as infinite or NaN
                ex, ey, det = x_to - xd, y_to - yd, a * d - b * b
                step_x, step_y = (d * ex - b * ey) / det, (a * ey - b * ex) / det
                x, y = x + step_x, y + step_y
                if not any(np.any(np.abs(step) > _NEWTON_TOLERANCE) for step in (step_x, step_y)):
                    break
            ends = zip(self._distorted(x, y), (x_to, y_to), strict=True)
            # 1e-9 px at any focal length of a webcam
            good = np.logical_and(*(np.abs(end - to) < 1e-12 for end, to in ends))
        return np.where(good[..., None], _pairs(x, y), np.nan)

    def rays(self, uv_px: Array) -> Array:
        """Unit chief-ray directions in the camera frame, shape (..., 3), of pixels (u, v), shape (..., 2)."""
        xy = self.normalised(uv_px)
        # z = 1 before the norm: the camera looks along +z
        directions = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        return directions / np.linalg.norm(directions, axis=-1, keepdims=True)

    def solid_angle_density(self, xy: Array) -> Array:
        """|d(x, y) / d(u, v)|, shape (...): area of normalised coordinates per square pixel."""
        J = self.distort_jacobian(xy)
        return 1.0 / np.abs((J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]) * self.fx_px * self.fy_px)

    def _check_one_to_one(self) -> None:
        """Raise `SceneError` if the distortion folds: pixel and direction belong to each other up to the corners."""
        fold = _fold_px(self)
        if fold is not None:
            raise SceneError(
                f"Camera: the distortion k1 = {self.k1:g}, k2 = {self.k2:g}, k3 = {self.k3:g}, p1 = {self.p1:g}, "
                f"p2 = {self.p2:g} folds near pixel ({fold[0]:.0f}, {fold[1]:.0f}): it must be one-to-one over the "
                "image; take smaller coefficients, and set all of k1, k2, k3 when a preset's are changed"
            )

    def contains(self, uv_px: Array) -> BoolArray:
        """Mask of the pixels (u, v), shape (..., 2), inside the image [-0.5, W - 0.5] x [-0.5, H - 0.5]."""
        uv = np.asarray(uv_px, float)
        # integers are pixel centres, so that the image begins at -0.5
        inside_u = (uv[..., 0] >= -0.5) & (uv[..., 0] <= self.width_px - 0.5)
        return inside_u & (uv[..., 1] >= -0.5) & (uv[..., 1] <= self.height_px - 0.5)


def _pairs(x: Array, y: Array) -> Array:
    """Two arrays (...) as one (..., 2); `np.stack` takes three times as long for a few points."""
    pairs = np.empty((*x.shape, 2), dtype=x.dtype)
    pairs[..., 0], pairs[..., 1] = x, y
    return pairs


@lru_cache(maxsize=256)  # rigs are varied parameter by parameter, pair after pair
def _fold_px(camera: Camera) -> tuple[float, float] | None:
    """Pixel of the fold of a camera's distortion that is nearest to the image's centre; None if there is none.

    The Jacobian must stay positive all the way from the centre to each pixel of a grid, a blur's width beyond the
    image: elsewhere a pixel would see two directions, or none.
    """
    low = -0.5 - _FOLD_MARGIN_PX
    high = np.array([camera.width_px, camera.height_px]) - 0.5 + _FOLD_MARGIN_PX
    # 40 px apart at 1280 x 720: radial terms are smooth
    u, v = np.meshgrid(np.linspace(low, high[0], 33), np.linspace(low, high[1], 19))
    uv = np.stack([u.ravel(), v.ravel()], axis=-1)
    xy = camera.normalised(uv)
    way = np.linspace(0.0, 1.0, 17)[1:, None, None] * xy  # a fold between centre and pixel counts as well
    J = camera.distort_jacobian(way)
    with np.errstate(invalid="ignore"):
        good = np.all(J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0] > 0.0, axis=0)
    if good.all():
        return None
    u_px, v_px = uv[~good][np.argmin(np.linalg.norm(uv[~good] - uv.mean(axis=0), axis=-1))]
    return float(u_px), float(v_px)
