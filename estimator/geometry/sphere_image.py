"""Image of one point in a perfect sphere, and its light, in plain floats: for loops of thousands of steps a second.

`reflection.image_of` holds for every mirror and for arrays, and takes milliseconds a call. Here camera, sphere centre
and point span a plane; the reflection point is one angle in it. With S the centre, e the unit vector from S to the
lens, l their distance, and the point at w beside and y along e, the mirror point at the angle p has

    tan b = R sin p / (l - R cos p)                             b: camera ray against -e
    t = 2 p + b                                                 t: reflected ray against e
    f(p) = (w - R sin p) cos t - (y - R cos p) sin t = 0

which Newton's method solves. A step of the point across the ray, within the plane, changes f by its length, so that b
turns by b' / |f'|; a step across the plane turns the plane by step / w. The product is the solid angle in the lens per
area at the point, and with the aperture the etendue: the same light as `spot_prediction.spot_electrons_per_s` gives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from phibench.estimator.geometry.reflection import GRAZING_COSINE
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

_STEPS = 30  # 4 to 6 do, but for points close to the mirror
_CLOSE_RAD = 1e-13  # a step below which the angle has all its digits
_NODES = 512  # of the reflectance, which is smooth in the cosine: interpolated to 1e-6


class SphereImage(NamedTuple):
    """Image of a point.

    Attributes
    ----------
    cos_incidence : float
        At the mirror.
    ray : 3 floats
        Unit direction of the ray from the mirror to the point.
    etendue_m2_sr_per_m2 : float
        Of the aperture, by the area at the point across the ray.
    """

    u_px: float
    v_px: float
    cos_incidence: float
    ray: tuple[float, float, float]
    etendue_m2_sr_per_m2: float


@dataclass(frozen=True)
class _Camera:
    """Numbers of the camera as floats; the matrix takes world directions into the camera."""

    matrix: tuple[tuple[float, float, float], ...]
    centre: tuple[float, float, float]
    fx: float
    fy: float
    cx: float
    cy: float
    straight: bool
    aperture_m2: float


class SphereImager:
    """Images of points in the sphere of a rig at its down position; a raised rig sees a lowered point.

    Parameters
    ----------
    rig : Rig
        With a perfect sphere, without a glass tube.
    wavelength_nm : float
        Of the light.

    Raises
    ------
    SceneError
        If the mirror is no perfect sphere, or glass is around it.
    """

    def __init__(self, rig: Rig, wavelength_nm: float = 650.0) -> None:
        sphere, view = rig.sphere, rig.at(0.0)
        if sphere.form is not None or view.tube is not None:
            raise SceneError(
                "SphereImager: the mirror has a form error or a glass tube; give the rig a perfect sphere in air"
            )
        camera, T = rig.camera, view.T_world_camera
        to_lens = T.t - view.sphere_centre_m
        self.rig = rig
        self.radius_m, self.distance_m = sphere.radius_m, float(np.linalg.norm(to_lens))
        self._centre: tuple[float, float, float] = tuple(view.sphere_centre_m.tolist())
        self._axis: tuple[float, float, float] = tuple((to_lens / self.distance_m).tolist())
        self._camera = _Camera(
            tuple(tuple(row) for row in T.R.T.tolist()),
            tuple(T.t.tolist()),
            camera.fx_px,
            camera.fy_px,
            camera.cx_px,
            camera.cy_px,
            not any((camera.k1, camera.k2, camera.k3, camera.p1, camera.p2)),
            math.pi * camera.aperture_radius_m**2,
        )
        # at the limb p + b is a right angle: cos p = R / l
        self._limb_rad = math.acos(self.radius_m / self.distance_m)
        self._reflectance = sphere.reflectance(np.linspace(0.0, 1.0, _NODES), wavelength_nm).tolist()

    def image(self, x_m: float, y_m: float, z_m: float) -> SphereImage | None:
        """Image of a point in the rig's frame; None where the mirror does not show it."""
        (sx, sy, sz), (ex, ey, ez) = self._centre, self._axis
        dx, dy, dz = x_m - sx, y_m - sy, z_m - sz
        y = dx * ex + dy * ey + dz * ez
        ax, ay, az = dx - y * ex, dy - y * ey, dz - y * ez
        w = math.sqrt(ax * ax + ay * ay + az * az)
        # on the axis the azimuth is not defined, and a point within the ball has no image
        if not (w > 1e-9 and w * w + y * y > self.radius_m**2):
            return None
        ax, ay, az = ax / w, ay / w, az / w
        p, b, b1, slope = self._reflection(w, y)
        cosine = math.cos(p + b)
        if not cosine > GRAZING_COSINE or math.isnan(p):
            return None
        sin_b, cos_b, t = math.sin(b), math.cos(b), 2.0 * p + b
        sin_t, cos_t = math.sin(t), math.cos(t)
        pixel = self._pixel((sin_b * ax - cos_b * ex, sin_b * ay - cos_b * ey, sin_b * az - cos_b * ez))
        if pixel is None:
            return None
        ray = (sin_t * ax + cos_t * ex, sin_t * ay + cos_t * ey, sin_t * az + cos_t * ez)
        etendue = self._camera.aperture_m2 * pixel[2] * b1 / slope * sin_b / w
        return SphereImage(pixel[0], pixel[1], cosine, ray, etendue)

    def reflectance(self, cos_incidence: float) -> float:
        """Part of the light that the mirror keeps."""
        # table of even steps in the cosine, straight between two nodes
        place = cos_incidence * (_NODES - 1)
        low = min(int(place), _NODES - 2)
        left, right = self._reflectance[low], self._reflectance[low + 1]
        return float(left + (place - low) * (right - left))

    def mirror_point_m(self, image: SphereImage, x_m: float, y_m: float, z_m: float) -> Array:
        """Point of the mirror that shows a point, shape (3,): where the ray back from the point meets the sphere."""
        point, ray = np.array([x_m, y_m, z_m]), np.array(image.ray)
        from_centre = point - np.array(self._centre)
        along = from_centre @ ray
        # first of two crossings, seen from the point; rounding at the limb would give a negative square
        root = math.sqrt(max(along**2 - from_centre @ from_centre + self.radius_m**2, 0.0))
        return np.asarray(point - (along - root) * ray)

    @property
    def lens_m(self) -> Array:
        """Lens centre in the rig's frame, shape (3,)."""
        return np.array(self._camera.centre)

    def _reflection(self, w: float, y: float) -> tuple[float, float, float, float]:
        """Angles p and b, the derivative b' of b by p, and |f'|; NaN where Newton's method does not come to rest."""
        R, dist = self.radius_m, self.distance_m
        # near the axis b = R p / (dist - R), and a far point is seen at 2 p + b; a start on the limb has no slope
        p = min(math.atan2(w, y) / (2.0 + R / (dist - R)), 0.99 * self._limb_rad)
        for _ in range(_STEPS):
            s, c = math.sin(p), math.cos(p)
            b = math.atan2(R * s, dist - R * c)
            b1 = (R * dist * c - R * R) / (dist * dist + R * R - 2.0 * dist * R * c)
            t = 2.0 * p + b
            sin_t, cos_t = math.sin(t), math.cos(t)
            # miss of the reflected ray at the point, and the way to it
            across, along = (w - R * s) * cos_t - (y - R * c) * sin_t, (w - R * s) * sin_t + (y - R * c) * cos_t
            # derivative of the miss by p, the place on the mirror
            slope = R * math.cos(t - p) + (2.0 + b1) * along
            step = across / slope
            if abs(step) < _CLOSE_RAD:
                return p, b, b1, slope
            p = min(max(p + step, 0.0), self._limb_rad)
        return (math.nan,) * 4

    def _pixel(self, d: tuple[float, float, float]) -> tuple[float, float, float] | None:
        """Pixel of a unit direction and its cosine against the optical axis; None outside of the image."""
        m, rig = self._camera.matrix, self.rig
        x, y, z = (row[0] * d[0] + row[1] * d[1] + row[2] * d[2] for row in m)
        if z <= 0.0:
            return None
        if self._camera.straight:
            u, v = self._camera.fx * x / z + self._camera.cx, self._camera.fy * y / z + self._camera.cy
        else:
            u, v = rig.camera.to_pixel(np.array([x / z, y / z])).tolist()
        if not (-0.5 <= u <= rig.camera.width_px - 0.5 and -0.5 <= v <= rig.camera.height_px - 0.5):
            return None
        return u, v, z
