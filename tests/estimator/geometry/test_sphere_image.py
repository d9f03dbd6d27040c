"""Images of single points in the sphere against the general inverse, and their light against the closed form."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.sphere_image import SphereImager
from phibench.estimator.geometry.status import Status
from phibench.estimator.spots.spot_prediction import Laser, spot_electrons_per_s
from phibench.scenes.holder import fitted_holder
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.scenes.room import c310_rig
from phibench.scenes.validation import SceneError

CROOKED = Misalignment(tilt_x_rad=0.01, tilt_y_rad=-0.02, decentre_x_m=2e-3)


@pytest.mark.parametrize("rig", [Rig(), c310_rig().perturbed(CROOKED)], ids=["drawn", "crooked"])
def test_pixel_and_light_agree_with_the_general_ones(rig: Rig) -> None:
    """The pixels by Newton's method on rays, in two dimensions; the light by their derivatives."""
    rng, laser, imager = generator("test", "sphere image"), Laser(), SphereImager(rig)
    points = rng.uniform([-5, -5, 0], [5, 5, 2.5], (300, 3))
    normals = rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    general = image_of(rig.at(0.0), points)
    light = spot_electrons_per_s(rig, laser, general, normals)
    per_joule = rig.camera.detector.laser_electrons_per_joule(laser.wavelength_nm)[0]
    seen = 0
    for k, point in enumerate(points):
        found = imager.image(*point)
        if found is None:
            assert general.status[k] != Status.OK or not rig.camera.contains(general.uv_px[k])
            continue
        seen += 1
        assert (found.u_px, found.v_px) == pytest.approx(general.uv_px[k], abs=1e-9)
        watts = imager.reflectance(found.cos_incidence) * laser.albedo * laser.power_w / np.pi
        cosine = abs(np.array(found.ray) @ normals[k])
        # the general one takes the incidence from the pixel; near the limb the reflectance's nodes leave 3e-5
        assert watts * found.etendue_m2_sr_per_m2 * cosine * per_joule == pytest.approx(light[k], rel=1e-4)
        mirror = imager.mirror_point_m(found, *point)
        assert np.linalg.norm(mirror - rig.at(0.0).sphere_centre_m) == pytest.approx(imager.radius_m, abs=1e-12)
        assert np.cross(point - mirror, found.ray) == pytest.approx(0.0, abs=1e-9)
    assert seen > 280


def test_points_that_the_mirror_does_not_show_have_no_image() -> None:
    rig = Rig()
    imager, centre = SphereImager(rig), rig.at(0.0).sphere_centre_m
    assert imager.image(*centre) is None  # inside
    assert imager.image(centre[0], centre[1], centre[2] + 3.0) is None  # straight behind the mirror
    assert imager.image(0.001, 0.0, centre[2] + 3.0) is None
    assert imager.image(3.0, 0.0, 0.5) is not None


def test_other_mirrors_are_refused() -> None:
    bent = Rig().perturbed(Misalignment(form_20_m=1e-5))
    with pytest.raises(SceneError, match="perfect sphere"):
        SphereImager(bent)
    in_glass = dataclasses.replace(Rig(), holder=fitted_holder("tube", 0.06))
    with pytest.raises(SceneError, match="perfect sphere"):
        SphereImager(in_glass)
