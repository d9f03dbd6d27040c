"""Mitsuba sensor plugin of the camera: thin lens, focus, Brown distortion and its inverse, blur, weight in electrons.

Mitsuba's film coordinate is u + 0.5: its pixel centres are half integers. The scene is in millimetres, with the origin
at the sphere centre. The weight of a ray is its etendue times electrons per joule: an image of radiance in W/(m^2 sr)
comes out in expected photo-electrons per second and pixel.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.camera import Camera
from phibench.scenes.rig import View

PLUGIN = "c310"
MM_PER_M = 1000.0
_MOST_STEPS = 12
_CLOSE = 1e-12  # normalised image coordinates
_ROUNDED = 3e-7  # three times what float32 leaves
_TAIL_SIGMAS = 6.0  # of the blur, beyond the image


def camera_plugin_dict(mi: ModuleType, view: View, crop: tuple[int, int, int, int] | None = None) -> dict[str, Any]:
    """Mitsuba dictionary of the sensor for one view.

    Parameters
    ----------
    mi : module
        Mitsuba with its variant set.
    crop : (u0, v0, width, height), or None
        Image window in pixels; None is the whole image.
    """
    _register(mi)
    camera = view.rig.camera
    film = {"type": "hdrfilm", "width": camera.width_px, "height": camera.height_px, "component_format": "float32"}
    film |= {"pixel_format": "rgb", "rfilter": {"type": "box"}, "sample_border": False}
    if crop is not None:
        keys = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        film |= dict(zip(keys, crop, strict=True))
    numbers = {name: float(getattr(camera, name)) for name in _CAMERA_NUMBERS}
    axes = view.T_world_camera.R
    for column, axis in enumerate("xyz"):
        numbers |= {f"{axis}_{row}": float(axes[i, column]) for i, row in enumerate("xyz")}
    position = MM_PER_M * view.T_world_camera.directions(-view.rig.T_camera_sphere.t)
    numbers |= {f"origin_{row}": float(position[i]) for i, row in enumerate("xyz")}
    numbers["single_steps"], numbers["double_steps"] = undistort_steps(camera)
    numbers["aperture_radius_m"] = camera.aperture_radius_m
    for name, value in zip("RGB", camera.detector.band_electrons_per_joule(), strict=True):
        numbers[f"electrons_per_joule_{name}"] = value
    return {"type": PLUGIN, "film": film, "sampler": {"type": "multijitter"}, **numbers}


_CAMERA_NUMBERS = (
    *("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2"),
    *("focus_distance_m", "blur_sigma_px"),
)


def _register(mi: ModuleType) -> None:
    """Define and register the plugin class; Mitsuba's classes exist only once a variant is set."""
    import drjit as dr

    class C310(mi.Sensor):  # type: ignore[name-defined]
        """See the module's docstring."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            number = {name: float(props[name]) for name in props.keys() if name not in _NOT_NUMBERS}  # noqa: SIM118
            number |= {f"per_{name}": 1.0 / number[name] for name in ("fx_px", "fy_px", "focus_distance_m")}
            lens = math.pi * number["aperture_radius_m"] ** 2 * number["per_fx_px"] * number["per_fy_px"]
            self.number = {name: mi.Float64(value) for name, value in number.items()}
            self.weights = [mi.Float(lens * number[f"electrons_per_joule_{c}"]) for c in "RGB"]
            dr.make_opaque(self.number, self.weights)  # same kernel for every camera
            self.steps = int(props["single_steps"]), int(props["double_steps"])
            self.m_needs_sample_2 = True
            self.m_needs_sample_3 = True

        def sample_ray(self, time, wavelength_sample, position_sample, aperture_sample, active=True):  # type: ignore[no-untyped-def]
            samples = (time, wavelength_sample, position_sample, aperture_sample, active)
            ray, weight = self.sample_ray_differential(*samples)  # type: ignore[no-untyped-call]
            return mi.Ray3f(ray), weight

        def sample_ray_differential(  # type: ignore[no-untyped-def]
            self, time, wavelength_sample, position_sample, aperture_sample, active=True
        ):
            film = self.film()
            size, offset = mi.ScalarVector2f(film.crop_size()), mi.ScalarVector2f(film.crop_offset())
            # optical blur: the film point moves by a Gaussian; its deviates are hashed from the two samples
            blur = mi.warp.square_to_std_normal(_hashed_pair(mi, dr, position_sample, aperture_sample))
            sigma = self.number["blur_sigma_px"]
            u = mi.Float64(position_sample.x) * size.x + offset.x - 0.5 + mi.Float64(blur.x) * sigma
            v = mi.Float64(position_sample.y) * size.y + offset.y - 0.5 + mi.Float64(blur.y) * sigma
            lens = mi.warp.square_to_uniform_disk_concentric(aperture_sample)
            origin, direction, weight = self.film_ray(u, v, lens)  # type: ignore[no-untyped-call]
            return mi.RayDifferential3f(mi.Point3f(origin), mi.Vector3f(direction), time, mi.Color0f()), weight

        def film_ray(self, u, v, lens):  # type: ignore[no-untyped-def]
            """Ray of a film position, float64 pixels, and a lens point: origin (mm), direction, weight.

            The weight is electrons/s per W/(m^2 sr). `lens` lies on the unit disc. Optical blur is the caller's.
            """
            n, F64 = self.number, mi.Float64
            xd, yd = (u - n["cx_px"]) * n["per_fx_px"], (v - n["cy_px"]) * n["per_fy_px"]
            x, y, jacobian = _undistort(mi, n, xd, yd, self.steps) if any(self.steps) else (xd, yd, None)
            a, b = F64(lens.x) * n["aperture_radius_m"], F64(lens.y) * n["aperture_radius_m"]
            dx, dy = x - a * n["per_focus_distance_m"], y - b * n["per_focus_distance_m"]
            cos2 = 1.0 / (1.0 + dx * dx + dy * dy)
            cos = dr.sqrt(cos2)
            origin = [n[f"origin_{i}"] + MM_PER_M * (a * n[f"x_{i}"] + b * n[f"y_{i}"]) for i in "xyz"]
            direction = [cos * (dx * n[f"x_{i}"] + dy * n[f"y_{i}"] + n[f"z_{i}"]) for i in "xyz"]
            slant = dr.square(mi.Float(cos2))  # solid angle and both cosines
            if jacobian is not None:
                slant /= jacobian
            return mi.Vector3d(*origin), mi.Vector3d(*direction), mi.Color3f(*(slant * one for one in self.weights))

        def bbox(self):  # type: ignore[no-untyped-def]
            return mi.ScalarBoundingBox3f()

        def to_string(self) -> str:
            return "C310[]"

    mi.register_sensor(PLUGIN, C310)


_NOT_NUMBERS = ("film", "sampler", "id", "single_steps", "double_steps")


def _hashed_pair(mi: ModuleType, dr: ModuleType, position: Any, aperture: Any) -> Any:
    """Two uniform deviates from the bits of four others (Tiny Encryption Algorithm)."""
    bits = [dr.reinterpret_array(mi.UInt32, value) for value in (position.x, position.y, aperture.x, aperture.y)]
    first = mi.sample_tea_32(bits[0], bits[1])
    second = mi.sample_tea_32(bits[2] ^ first[0], bits[3] ^ first[1])
    return mi.Point2f(*(mi.Float(word >> 8) * (1.0 / 16777216.0) for word in second))


def undistort_steps(camera: Camera) -> tuple[int, int]:
    """Newton steps in float32, then in float64, from the distorted position to the undistorted one; 0 without it.

    Those in float32 come within 3e-7 of it; what they leave, those in float64 bring below 1e-12 (1.4e-9 px). They are
    counted over a grid over the film.
    """
    if not any((camera.k1, camera.k2, camera.k3, camera.p1, camera.p2)):
        return 0, 0
    reach = math.ceil(_TAIL_SIGMAS * camera.blur_sigma_px)
    u, v = (np.linspace(-reach, size + reach, 33) for size in (camera.width_px, camera.height_px))
    film = np.stack(np.meshgrid(u, v), axis=-1)
    target = (film - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]

    def steps_from(xy: NDArray[np.float64], close: float) -> tuple[int, NDArray[np.float64]]:
        for step in range(1, _MOST_STEPS):
            xy = xy + np.linalg.solve(camera.distort_jacobian(xy), (target - camera.distort(xy))[..., None])[..., 0]
            if np.abs(camera.distort(xy) - target).max() < close:
                return step, xy
        return _MOST_STEPS, xy

    single, xy = steps_from(target, _ROUNDED)
    return single, steps_from(xy + _ROUNDED, _CLOSE)[0]


def _undistort(mi: ModuleType, n: dict[str, Any], xd: Any, yd: Any, steps: tuple[int, int]) -> tuple[Any, Any, Any]:
    """Invert Brown's distortion by Newton's method; also the determinant of its Jacobian at the solution, float32."""
    rounded = {name: mi.Float(n[name]) for name in ("k1", "k2", "k3", "p1", "p2")}
    target = mi.Float(xd), mi.Float(yd)
    x, y = target
    for _ in range(steps[0]):
        x, y = _newton(rounded, x, y, *target)
    x, y = mi.Float64(x), mi.Float64(y)
    for _ in range(steps[1]):
        x, y = _newton(n, x, y, xd, yd)
    xx, yy, xy, _ = _bent(rounded, mi.Float(x), mi.Float(y))
    return x, y, xx * yy - xy * xy


def _newton(n: dict[str, Any], x: Any, y: Any, xd: Any, yd: Any) -> tuple[Any, Any]:
    """Next place that is distorted to (xd, yd)."""
    xx, yy, xy, radial = _bent(n, x, y)
    r2 = x * x + y * y
    ex = x * radial + 2.0 * n["p1"] * x * y + n["p2"] * (r2 + 2.0 * x * x) - xd
    ey = y * radial + n["p1"] * (r2 + 2.0 * y * y) + 2.0 * n["p2"] * x * y - yd
    per_det = 1.0 / (xx * yy - xy * xy)
    return x - (yy * ex - xy * ey) * per_det, y - (xx * ey - xy * ex) * per_det


def _bent(n: dict[str, Any], x: Any, y: Any) -> tuple[Any, Any, Any, Any]:
    """Derivatives of Brown's distortion, d xd / dx, d yd / dy and d xd / dy = d yd / dx, and its radial factor."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (n["k1"] + r2 * (n["k2"] + r2 * n["k3"]))
    slope = 2.0 * (n["k1"] + r2 * (2.0 * n["k2"] + r2 * 3.0 * n["k3"]))
    xx = radial + x * x * slope + 2.0 * n["p1"] * y + 6.0 * n["p2"] * x
    yy = radial + y * y * slope + 6.0 * n["p1"] * y + 2.0 * n["p2"] * x
    return xx, yy, x * y * slope + 2.0 * (n["p1"] * x + n["p2"] * y), radial
