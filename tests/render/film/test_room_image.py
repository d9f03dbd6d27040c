"""Room from a light map in NumPy: furnace, textures and light by other ways, spots, and views that Mitsuba renders."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from phibench.render.film.room_image import LitRoom, quick_spot, room_image
from phibench.render.optics.beam_deposit import inside_reflectance
from phibench.render.optics.faces import TexelGrid
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.room_tracer import RoomGeometry, own_geometry
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.sensor.light import Region
from phibench.scenes.laser import LaserSpot
from phibench.scenes.motion.vehicle import PlanarPose, Stance, Vehicle, rig_placement
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room, lab
from phibench.scenes.shapes import Cuboid, Rectangle, cuboid

LEVEL = np.eye(3), np.zeros(3)
DISC = Region(400, 200, 440, 230)  # in the mirror's image, above the robot's
BESIDE = Region(20, 20, 60, 50)
LAB = replace(lab(), robot=False)


def lit(room: Room, irradiance_w_m2: float, linear: bool = False) -> LitRoom:
    """Room with even light, or with light that rises along world x."""
    geometry = own_geometry(room)
    texels = TexelGrid.of(geometry.table, 0.5)
    light = np.full((texels.count, 3), irradiance_w_m2)
    if linear:
        light += texels.points()[0][:, :1]
    return LitRoom(geometry, texels, light.astype(np.float32))


def box(albedo: float, coat: float = 0.0) -> Room:
    """Inside of six slabs about (0, 0, 3), 6 m wide."""
    sides = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            centre, size = np.array([0.0, 0.0, 3.0]), np.full(3, 6.4)
            centre[axis] += side * 3.1
            size[axis] = 0.2
            sides.append(cuboid(f"s{axis}{side:+.0f}", tuple(centre), tuple(size), (albedo,) * 3, coat=coat))
    return Room("box", (), tuple(sides), robot=False)


def test_a_furnace_is_as_bright_as_its_walls() -> None:
    """Radiance a E / pi from everywhere: electrons are that times etendue, efficiency and the mirror's reflectance."""
    rig = Rig()
    view, camera, room = rig.at(0.2), rig.camera, lit(box(0.5), 4.0)
    gain = np.array(camera.detector.band_electrons_per_joule())
    for region, mirrored in ((DISC, True), (BESIDE, False)):
        image = room_image(view, LEVEL, room, region)[:, 15, 20]
        u, v = region.u0_px + 20, region.v0_px + 15
        x, y = (u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px
        etendue = math.pi * camera.aperture_radius_m**2 / (1.0 + x * x + y * y) ** 2 / (camera.fx_px * camera.fy_px)
        expected = 0.5 * 4.0 / math.pi * etendue * gain
        if mirrored:
            # the angle between the ray and the sphere's normal: sin(i) / distance = sin(angle at the lens) / radius
            at_lens = math.atan(math.hypot(x, y))
            d, R = float(np.linalg.norm(rig.T_camera_sphere.t)), rig.sphere.radius_m
            cos_i = math.sqrt(1.0 - (d * math.sin(at_lens) / R) ** 2)
            for band, nm in enumerate(camera.detector.band_wavelength_nm):
                expected[band] *= float(rig.mirror.reflectance(np.array(cos_i), nm))
        # cos^4 and the reflectance bend by less than 1e-4 within a blur of 0.8 px or a step of 4 px
        assert image == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_faces_send_out_albedo_times_light() -> None:
    """Each hit by its texture's own formula, and light that is linear in space, which bilinear texels give exactly."""
    room, rng = lit(LAB, 9.0, linear=True), generator("test", "faces")
    d = rng.standard_normal((4000, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    o = np.broadcast_to([0.1, 0.2, 1.0], d.shape)
    hits, found, checked = room.geometry.first_hit(o, d), room.seen(o, d), 0
    shapes, table = room.geometry.shapes, room.geometry.table
    for k in np.flatnonzero(hits.patch >= 0):
        patch, shape = int(hits.patch[k]), shapes[hits.object_id[k]]
        point = o[k] + hits.distance_m[k] * d[k]
        if table.emits[patch] or table.coat[patch] > 0.0 or not isinstance(shape, Rectangle | Cuboid):
            continue
        if np.ptp(table.normal[patch] @ d[k]) or table.normal[patch] @ d[k] > 0.0:
            continue
        albedo = table.textures[table.texture[patch]].evaluate(table.local_m(np.array([patch]), point[None]))[0]
        assert found[k] == pytest.approx(albedo * (9.0 + point[0]) / math.pi, rel=1e-6)  # float32 light
        checked += 1
    assert checked > 1000


def test_lamps_are_as_bright_as_they_are_stated() -> None:
    room = lit(LAB, 0.0)
    lamps = [shape for shape in LAB.surfaces if max(shape.radiance_w_m2_sr) > 0.0]
    assert lamps
    for lamp in lamps:
        pose = lamp.T_world_shape
        start, normal = pose.t + 0.3 * pose.R[:, 2], pose.R[:, 2]
        assert room.seen(start[None], -normal[None])[0] == pytest.approx(lamp.radiance_w_m2_sr)


def test_coats_keep_the_light_of_a_white_furnace() -> None:
    """A white ground below a coat, lit by 1 - r of even light pi, sends out 1 - F: the coat mirrors F of its opposite.

    Perpendicular rays: 1 - F + F (1 - F), F = 0.04 for n = 1.5.
    """
    n = 1.5
    outside = 1.0 - n**2 * (1.0 - inside_reflectance(n))
    room = lit(box(1.0, coat=n), math.pi * (1.0 - outside))
    seen = room.seen(np.array([[0.0, 0.0, 3.0]]), np.array([[1.0, 0.0, 0.0]]))[0]
    assert seen == pytest.approx(1.0 - 0.04**2, rel=1e-6)


def test_grids_of_rays_see_what_single_ones_see() -> None:
    """Of 19 200 pixels fewer than 2 % differ: edges of what coats mirror, and what is narrower than two pixels."""
    rig = Rig()
    uv = np.stack(np.meshgrid(np.arange(380, 540), np.arange(120, 240)), axis=-1).reshape(-1, 2).astype(float)
    rays, room = trace_pixels(rig.at(0.1), uv), lit(LAB, 9.0, linear=True)
    grid = np.ones((120, 160), bool)
    each, together = (
        room.seen(rays.points_m, rays.directions),
        room.seen_on_grid(rays.points_m, rays.directions, grid),
    )
    off = np.abs(each - together).max(axis=1) > 0.03 * each.max(axis=1)
    assert off.mean() < 0.02


def test_a_robot_that_drives_sees_the_room_move_the_other_way() -> None:
    """The rig turned and shifted in the room is the room turned and shifted about the rig, robot included."""
    placement = R, origin = rig_placement(Vehicle(), PlanarPose(0.5, -0.3, 0.7), Stance())
    walls = [
        cuboid(wall.name, wall.T_world_shape.t, wall.size_m, (0.1 * k + 0.1,) * 3)
        for k, wall in enumerate(box(0.5).furniture)
        if isinstance(wall, Cuboid)
    ]
    moved = [cuboid(wall.name, R.T @ (wall.T_world_shape.t - origin), wall.size_m, wall.texture, R.T) for wall in walls]
    view, region = Rig().at(0.1), Region(600, 330, 680, 400)
    one, other = (
        room_image(view, place, lit(Room("walls", (), tuple(shapes), robot=False), 4.0), region)
        for place, shapes in ((placement, walls), (LEVEL, moved))
    )
    assert one == pytest.approx(other, rel=1e-5)
    assert np.ptp(one) > 0.1 * one.max()  # walls, floor and robot are there


@pytest.mark.parametrize("point", [(2.0, 1.0, 0.8), (-1.0, 0.4, 0.3), (0.5, -4.0, 1.2)])
def test_quick_spots_are_those_of_many_pairs(point: tuple[float, float, float]) -> None:
    """49 pairs err by the sixth order of disc over blur, (0.3 / 0.7)^6 / 720 = 1e-5 of the peak; 1e-4 is allowed."""
    view, towards = Rig().at(0.3), -np.array([*point[:2], 0.0])
    spot = LaserSpot(point, tuple(towards / np.linalg.norm(towards)), 5e-3)
    quick, full = quick_spot(view, spot), spot_layer(view, spot, RoomGeometry())
    images = np.zeros((2, 40, 40))
    for image, layer in zip(images, (quick, full), strict=True):
        v, u = layer.v0_px - full.v0_px + 10, layer.u0_px - full.u0_px + 10
        height, width = layer.electrons_per_s.shape[1:]
        image[v : v + height, u : u + width] = layer.electrons_per_s[0]
    assert np.abs(images[0] - images[1]).max() < 1e-4 * images[1].max()
    assert quick.total_electrons_per_s == pytest.approx(full.total_electrons_per_s, rel=1e-5)


@pytest.mark.slow
def test_accuracy_of_rooms_without_mitsuba(capsys) -> None:
    """Half of all pixels within a tenth of the sensor's noise of the rendered view; edges and glints differ more."""
    from phibench.datasets.build.view_task import start_renderer
    from phibench.render.room.ambient_layer import render_ambient
    from phibench.render.room.light_map import BakeSettings, bake

    start_renderer()
    settings, view, region = BakeSettings(0.1, 0.2, 16, 4, 16, 64), Rig().at(0.1), Region(380, 120, 540, 240)
    light = bake(view, LAB, settings)
    rendered = render_ambient(view, LAB, light, settings, 2, 1, crop=(380, 120, 160, 120)).electrons_per_s
    geometry = own_geometry(LAB)
    room = LitRoom(geometry, TexelGrid.of(geometry.table, settings.texel_m), light.irradiance_w_m2)
    mine = room_image(view, LEVEL, room, region)
    off = np.abs(mine - rendered) / 60.0 / np.sqrt(rendered / 60.0 + 16.0)
    with capsys.disabled():
        print(f"of the noise at 1/60 s: median {np.median(off):.3f}, above 1 {(off > 1.0).mean():.2%}")
    assert np.median(off) < 0.1
    assert (off > 1.0).mean() < 0.1
