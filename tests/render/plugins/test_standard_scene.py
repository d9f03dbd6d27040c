"""Trees of standard plugins: rays of the sensor, reflectance of the mirror, what shines, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.oracles import TARGETS

from phibench.datasets.scene.scene_export import as_radiance
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.plugins.plugin_tree import BitmapPlugin, Plugin, Rgb, Triangles, mitsuba_dict
from phibench.render.plugins.room_plugins import mirror_bsdf, to_scene_mm
from phibench.render.plugins.standard_scene import etendue, exported_camera, sensor_plugin, standard_scene
from phibench.render.setup.variant import activate
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.metals import ReflectanceTable
from phibench.scenes.mirror import SphereMirror
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room, c310_camera, default_rig, lab
from phibench.scenes.shapes import rectangle
from phibench.scenes.validation import SceneError

BANDS_NM = (610.0, 540.0, 460.0)
CAMERAS = {
    "default": Camera(),
    "principal point to the right": replace(Camera(), cx_px=660.13, cy_px=351.7),
    "to the left": replace(Camera(), cx_px=600.0, cy_px=380.9),
    "left of the image": replace(Camera(), cx_px=-40.2),
    "unlike pixels": replace(Camera(), fy_px=1430.5),
    "distorted": c310_camera(),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_rays_of_the_standard_sensor(name: str) -> None:
    """Rays of pixels, corners included, lead to the points that the exported camera projects to them, within 2e-3 px.

    Mitsuba computes them in float32, from a film of up to 1400 pixels: 1400 x 6e-8 x some operations.
    """
    mi, camera = activate(), CAMERAS[name]
    rig = Rig(camera, T_world_camera=Pose("world", "camera", (0.02, -0.01, 0.45), rotation_xyz(0.02, -0.03, 0.1)))
    view = rig.at(0.3)
    scene = mi.load_dict(mitsuba_dict(mi, Plugin("scene", "scene", {"sensor": sensor_plugin(view)})))
    uv = np.array([[-0.5, -0.5], [1279.5, 719.5], [100.0, 650.0], [639.5, 359.5]])
    place = mi.Point2f(*((uv[:, i] + 0.5) / size for i, size in enumerate((1280, 720))))
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.0, place, mi.Point2f(0.5, 0.5))
    # where the lens's middle looks at 0.4 m; float64 from here
    o, d = (np.array(part, dtype=float).T for part in (ray.o, ray.d))
    seen = o + 400.0 * d
    points = view.T_world_camera.inverse().points(seen / 1000.0 + view.sphere_centre_m)
    assert np.abs(exported_camera(camera).project(points) - uv).max() < 2e-3
    lens = to_scene_mm(view, view.camera_centre_m)
    assert np.linalg.norm(np.cross(lens - o, d), axis=1).max() < 1e-3  # rays pass the lens's middle, mm


def test_an_exported_camera_is_the_camera_without_what_it_cannot_have() -> None:
    assert exported_camera(Camera()) == Camera()
    assert exported_camera(c310_camera()) == replace(c310_camera(), k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
    assert exported_camera(replace(Camera(), fy_px=1500.0)).fy_px == 1430.0
    # a short focal length leaves no room for a quarter of a pixel
    short = replace(Camera(), fx_px=150.0, fy_px=150.0, cx_px=640.7)
    assert exported_camera(short).cx_px == 640.5


def test_reflectance_of_the_conductor() -> None:
    """The exported material reflects what `MetalSurface.reflectance` says. float32: 1e-6."""
    mi = activate()
    cos = 0.6
    for mirror in (
        SphereMirror(),
        SphereMirror(metal="gold"),
        SphereMirror(reflectance_table=ReflectanceTable((550.0,), (0.4,))),
        SphereMirror(reflectance_table=ReflectanceTable((460.0, 610.0), (0.3, 0.6), (8.0,))),
    ):
        bsdf = mi.load_dict(mitsuba_dict(mi, mirror_bsdf(mirror, BANDS_NM)))
        si = mi.SurfaceInteraction3f()
        si.wi = mi.Vector3f(float(np.sqrt(1.0 - cos**2)), 0.0, cos)
        _, weight = bsdf.sample(mi.BSDFContext(), si, 0.5, mi.Point2f(0.5, 0.5))
        ours = [float(mirror.reflectance(np.array(cos), nm)) for nm in BANDS_NM]
        assert np.array(weight).ravel() == pytest.approx(ours, rel=1e-5)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (ReflectanceTable((550.0,), (0.4, 0.5), (0.0, 60.0)), "at 2 angles"),
        (ReflectanceTable((550.0,), (0.9,)), "above that of its metal"),
    ],
)
def test_a_mirror_that_no_standard_plugin_holds_is_one_sentence(table: ReflectanceTable, words: str) -> None:
    view = replace(default_rig(), mirror=SphereMirror(reflectance_table=table)).at(0.0)
    with pytest.raises(SceneError, match=words) as caught:
        standard_scene(view, lab(TARGETS))
    assert "\n" not in str(caught.value)
    assert "render a sample" in str(caught.value)


def test_lamps_of_the_spots_scene_are_off_and_reflect_nothing() -> None:
    tree = standard_scene(default_rig().at(0.0), lab(TARGETS), light="spot")
    lit = standard_scene(default_rig().at(0.0), lab(TARGETS), light="ambient")
    lamp = next(value for value in tree.values.values() if isinstance(value, Plugin) and value.label == "lamp_0")
    assert "emitter" not in lamp.values
    assert lamp.values["bsdf"].values["reflectance"] == Rgb((0.0, 0.0, 0.0))
    assert sum("emitter" in v.values for v in lit.values.values() if isinstance(v, Plugin)) == 6


def test_both_positions_share_meshes() -> None:
    """Meshes lie in the world's or their shape's frame."""
    trees = [standard_scene(default_rig().at(h), lab(TARGETS)) for h in (0.0, 0.4)]
    down, up = ([v.data() for v in tree.all_values() if isinstance(v, Triangles)] for tree in trees)
    assert len(down) > 2
    assert down == up


def test_electrons_of_a_radiance() -> None:
    """pi a^2 cos^4 / f^2 times electrons per joule."""
    camera = Camera()
    u = 639.5 + 1430.0 * np.tan(np.radians(20.0))
    of_axis, of_side = etendue(camera, np.array([[639.5, 359.5], [u, 359.5]]))
    assert of_side / of_axis == pytest.approx(np.cos(np.radians(20.0)) ** 4)
    area = np.pi * (0.5 * 1430.0 * 2.8e-6 / 2.4) ** 2 / 1430.0**2
    assert of_axis == pytest.approx(area * np.array(camera.detector.band_electrons_per_joule()))


def test_a_picture_reads_back_in_its_order(tmp_path: Path) -> None:
    """Rows and columns as they were: a file and an array make the same texture."""
    values = np.random.default_rng(0).uniform(size=(3, 5, 3)).astype(np.float32)
    path = tmp_path / "picture.pfm"
    path.write_bytes(BitmapPlugin("picture", values).data())
    assert np.array_equal(np.array(activate().Bitmap(str(path))), values)


def test_radiance_of_a_distorted_image() -> None:
    """Electrons of a uniform radiance, by the area that each pixel has on the unit plane, are that radiance again.

    Areas by central differences over 0.02 px: their error is of the third derivative, below 1e-7.
    """
    small = {"width_px": 160, "height_px": 90, "fx_px": 179.0, "fy_px": 179.0, "cx_px": 79.3, "cy_px": 44.9}
    camera = replace(c310_camera(), **small)
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    pixels = np.stack([u, v], axis=-1)
    steps = ((0.01, 0.0), (-0.01, 0.0), (0.0, 0.01), (0.0, -0.01))
    right, left, below, above = (camera.normalised(pixels + np.array(step)) for step in steps)
    (a, b), (c, d) = np.moveaxis(right - left, -1, 0), np.moveaxis(below - above, -1, 0)
    cos = camera.rays(pixels)[..., 2]
    etendues = np.pi * camera.aperture_radius_m**2 * np.abs(a * d - b * c) / 0.02**2 * cos**4
    electrons = etendues[..., None] * camera.detector.band_electrons_per_joule()
    radiance = as_radiance(camera, electrons)
    seen = np.isfinite(radiance)
    assert seen.mean() > 0.9  # but for a border of some pixels
    assert radiance[seen] == pytest.approx(1.0, abs=1e-6)


def test_mirror_in_even_light() -> None:
    """Radiance 1 from everywhere: pixels show the reflectance at their angle, by float64 rays and Fresnel's equations.

    No noise but that of places within a pixel and on the lens. The mean over 100 x 100 pixels to 1e-5: whatever float32
    does to the sphere, it changes no level.
    """
    sides = [(x, y, z) for x, y, z in np.concatenate([np.eye(3), -np.eye(3)])]
    walls = [
        rectangle(f"w{i}", (3 * x, 3 * y, 3 * z), (-x, -y, -z), (6.0, 6.0), radiance_w_m2_sr=(1.0, 1.0, 1.0))
        for i, (x, y, z) in enumerate(sides)
    ]
    mi, view = activate(), default_rig().at(0.0)
    scene = mi.load_dict(mitsuba_dict(mi, standard_scene(view, Room("box", tuple(walls), robot=False))))
    values = mi.traverse(scene.sensors()[0])
    values["film.crop_offset"], values["film.crop_size"] = [500, 200], [100, 100]
    values.update()
    image = np.array(mi.render(scene, spp=16, seed=0), dtype=float)
    u, v = np.meshgrid(np.arange(500.0, 600.0), np.arange(200.0, 300.0))
    cos = trace_pixels(view, np.stack([u.ravel(), v.ravel()], axis=-1)).cos_incidence.reshape(u.shape)
    for band, nm in enumerate(view.rig.camera.detector.band_wavelength_nm):
        ours = view.rig.mirror.reflectance(cos, nm)
        assert image[..., band].mean() == pytest.approx(ours.mean(), rel=1e-5)
        assert image[..., band] == pytest.approx(ours, rel=5e-4)
