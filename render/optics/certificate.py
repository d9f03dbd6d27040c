"""Certificate of a spot in one view: its chief ray and its spot layer compared with an independent ray tracer.

The world-side solution (`truth.spot_truth`, `spot_samples`) goes from the spot to the lens: Alhazen's problem and
Coddington's equations, or Fermat's path and its second derivatives where the mirror has a form error. The camera-side
solution is `traced_spot`: rays go from the film through the aperture to the mirror and on to the wall. The two sides
share the scene's numbers, no mathematics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.render.optics.room_tracer import GeometryLike, RoomGeometry, as_geometry
from phibench.render.optics.spot_layer import SpotLayer
from phibench.render.optics.traced_spot import RayBundle, aim, through_chief_point, trace_spot
from phibench.render.optics.truth import SpotTruth
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View

# Both chief rays are exact up to rounding. Centroid and flux: five and six times what the fewest rays leave, below.
# Place: of the light's rms extent on the surfaces, of which the fewest rays leave 0.03 % (80 spots of `bench-test`).
CHIEF_TOLERANCE_PX = 1e-6
CENTROID_TOLERANCE_PX = 2e-3
FLUX_TOLERANCE = 3e-3
PLACE_TOLERANCE = 5e-3
_LOG2_RAYS = (13, 15, 17, 19, 20)  # 13: centroid within 4e-4 px, flux within 5e-4, for the random rigs of the tests


@dataclass(frozen=True)
class Certificate:
    """Differences between two independent answers, and the tolerances they were held to.

    Attributes
    ----------
    chief_difference_px, chief_tolerance_px : float
        Closed form against ray tracer, chief ray.
    centroid_difference_px, centroid_tolerance_px : float
        Centroid of the spot layer's pixels against the centroid predicted by rays over aperture and spot.
    flux_difference, flux_tolerance : float
        Relative difference of the electrons per second of the same two.
    place_difference_m, place_tolerance_m : float
        Place of the light on the surfaces, of the same two.
    """

    chief_difference_px: float
    chief_tolerance_px: float
    centroid_difference_px: float
    centroid_tolerance_px: float
    flux_difference: float
    flux_tolerance: float
    place_difference_m: float
    place_tolerance_m: float
    passed: bool

    @property
    def chief_rays_agree(self) -> bool:
        """False where the places differ, which no number of rays mends."""
        return self.chief_difference_px <= self.chief_tolerance_px


def certify(view: View, spot: LaserSpot, room: GeometryLike, truth: SpotTruth, layer: SpotLayer) -> Certificate:
    """Check one visible spot. Raises nothing: look at `passed`.

    More rays are traced before a difference counts: the first few may not be enough for a wide or a cut image.
    """
    geometry, chief = as_geometry(room), np.array([truth.u_px, truth.v_px])
    start = through_chief_point(view, truth, np.zeros((1, 2)))
    chief_px = float(np.linalg.norm(aim(view, spot, RayBundle.chief(), np.zeros((1, 2)), start)[0] - chief))
    for log2_rays in _LOG2_RAYS:
        found = _differences(view, spot, geometry, truth, layer, log2_rays)
        # a NaN does not pass
        passed = (
            chief_px <= CHIEF_TOLERANCE_PX
            and found.centroid_px <= CENTROID_TOLERANCE_PX
            and found.flux <= FLUX_TOLERANCE
            and found.place_m <= found.place_tolerance_m
        )
        if passed:
            break
    return Certificate(
        chief_px,
        CHIEF_TOLERANCE_PX,
        found.centroid_px,
        CENTROID_TOLERANCE_PX,
        found.flux,
        FLUX_TOLERANCE,
        found.place_m,
        found.place_tolerance_m,
        passed,
    )


@dataclass(frozen=True)
class _Differences:
    """Centroid, pixels; relative flux; place on the surfaces and its tolerance, metres."""

    centroid_px: float
    flux: float
    place_m: float
    place_tolerance_m: float


def _differences(
    view: View, spot: LaserSpot, room: RoomGeometry, truth: SpotTruth, layer: SpotLayer, log2_rays: int
) -> _Differences:
    """Differences of layer and traced rays; 0 where both are dark."""
    traced = trace_spot(view, spot, room, truth, log2_rays)
    plane = brightest_plane(layer)
    gain = view.rig.camera.detector.laser_electrons_per_joule(spot.wavelength_nm)[plane]
    total = float(layer.electrons_per_s[plane].sum())
    if total == 0.0 and traced.watts * gain == 0.0:
        return _Differences(0.0, 0.0, 0.0, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        # NumPy's division: no light in one and some in the other is infinite, which does not pass
        flux = abs(np.float64(total) / (traced.watts * gain) - 1.0)
    return _Differences(
        float(np.linalg.norm(pixel_centroid(layer) - traced.centroid_px)),
        float(flux),
        float(np.linalg.norm(layer.place_m - traced.place_m)),
        PLACE_TOLERANCE * traced.extent_m,
    )


def brightest_plane(layer: SpotLayer) -> int:
    """Index of the brightest plane."""
    return int(np.argmax(layer.electrons_per_s.sum(axis=(1, 2))))


def pixel_centroid(layer: SpotLayer) -> Array:
    """Centroid (u, v), shape (2,), of the brightest plane's pixels."""
    image = layer.electrons_per_s[brightest_plane(layer)]
    v, u = np.indices(image.shape)
    with np.errstate(invalid="ignore"):
        total = image.sum()
        return np.array([(image * u).sum() / total + layer.u0_px, (image * v).sum() / total + layer.v0_px])
