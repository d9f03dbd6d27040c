"""Light maps and ambient layers against Mitsuba's path tracer, and against answers that are known."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from helpers.oracles import TARGETS
from helpers.path_ambient import path_trace

from phibench.render.optics.faces import TexelGrid, face_table
from phibench.render.room.ambient_layer import AmbientLayer, render_ambient
from phibench.render.room.light_map import BakeSettings, LightMap, bake
from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room, default_rig, lab
from phibench.scenes.shapes import Mesh, Prism, Uniform, cuboid, faces, rectangle

ROOM, RIG = lab(TARGETS), default_rig()
SETTINGS = BakeSettings(lamp_rays=32, bounce_rays=16, final_rays=256)
VIEW = RIG.at(0.425)
DEEP = 40  # bounces after which 0.6^40 = 1e-9 of the light is left

# Windows (u0, v0, width, height) of the mirror image and beside it.
CROPS = {
    "floor": (560, 220, 16, 16),
    "tile edge": (700, 440, 16, 16),
    "dark: robot's body": (590, 345, 16, 16),
    "edge of the body against the floor": (546, 330, 16, 16),
    "shadow edge under the table": (850, 225, 16, 16),
    "wall": (420, 300, 16, 16),
    "room corner": (790, 560, 16, 16),
    "shelf": (540, 590, 16, 16),
    "board": (594, 567, 16, 16),
    "ceiling in the mirror": (330, 360, 16, 16),
    "lamp": (760, 20, 16, 16),
    "ceiling beside the mirror": (100, 100, 16, 16),
}


QUICK = ("dark: robot's body", "lamp")  # the floor is compared pixel by pixel below; others are slow


COARSE = dataclasses.replace(SETTINGS, texel_m=2.0 * SETTINGS.texel_m)


@pytest.fixture(scope="module")
def light() -> LightMap:
    return bake(RIG.at(0.0), ROOM, SETTINGS)


@pytest.fixture(scope="module")
def coarse_light() -> LightMap:
    """A quarter of the texels: enough where light changes slowly, and baked in a quarter of the time."""
    return bake(RIG.at(0.0), ROOM, COARSE)


def _layer(light: LightMap, settings: BakeSettings, crop: tuple[int, int, int, int]) -> AmbientLayer:
    return render_ambient(VIEW, ROOM, light, settings, 4, 0, crop)


def _traced(crop: tuple[int, int, int, int], samples: int, runs: int) -> np.ndarray:
    """Independent path traced images, shape (runs, 3, height, width)."""
    return np.array([path_trace(VIEW, ROOM, samples, DEEP, seed, crop) for seed in range(runs)], dtype=float)


def check_means(light: LightMap, settings: BakeSettings, name: str) -> None:
    """Mean of a crop within 1 % plus 5 standard errors of the tracer's mean (false alarm 6e-7)."""
    traced = _traced(CROPS[name], 256, 4).mean(axis=(2, 3))
    mean, error = traced.mean(axis=0), traced.std(axis=0, ddof=1) / 2.0
    assert np.all(error < 0.006 * mean)
    ours = _layer(light, settings, CROPS[name]).electrons_per_s.mean(axis=(1, 2))
    print(name, ours / mean - 1.0, "+-", error / mean)
    assert np.all(np.abs(ours - mean) <= 0.01 * mean + 5.0 * error)


@pytest.mark.parametrize("name", QUICK)
def test_ambient_means_against_path_tracing(coarse_light: LightMap, name: str) -> None:
    check_means(coarse_light, COARSE, name)


@pytest.mark.slow
@pytest.mark.parametrize("name", CROPS)
def test_ambient_means_with_shipped_texels_against_path_tracing(light: LightMap, name: str) -> None:
    check_means(light, SETTINGS, name)


def check_pixels(light: LightMap, settings: BakeSettings, side_px: int) -> None:
    """Per-pixel z-scores on a smooth crop: their mean square is chi-square; a bias of 2 % is rejected.

    N pixels, 8 runs: z has Student's t distribution with 7 degrees of freedom, mean square 7/5, and the mean over N
    pixels scatters by about sqrt(var(t^2) / N) = sqrt(11.8 / N) (the fourth moment of t_7 is finite).
    Accepted: below 1.4 + 5 of these (false alarm below 1e-6). At 2.5 % noise per run a 2 % bias adds (2 / 0.9)^2 = 5.
    The floor in front of the robot, away from the mirror ball's shadow, which light maps leave out.
    """
    crop = (552, 208, side_px, side_px)
    runs = _traced(crop, 256, 8)[:, 0]
    mean, error = runs.mean(axis=0), runs.std(axis=0, ddof=1) / math.sqrt(len(runs))
    ours, limit = _layer(light, settings, crop).electrons_per_s[0], 1.4 + 5.0 * math.sqrt(11.8 / side_px**2)

    def mean_square(image: np.ndarray) -> float:
        return float(np.mean(((image - mean) / error) ** 2))

    print(mean_square(ours), mean_square(1.02 * ours), mean_square(0.98 * ours), limit)
    assert mean_square(ours) < limit
    assert mean_square(1.02 * ours) > limit
    assert mean_square(0.98 * ours) > limit


@pytest.mark.slow
def test_ambient_pixels_by_z_test_which_rejects_two_per_cent(coarse_light: LightMap) -> None:
    check_pixels(coarse_light, COARSE, 15)


@pytest.mark.slow
def test_ambient_pixels_with_shipped_texels_by_z_test(light: LightMap) -> None:
    check_pixels(light, SETTINGS, 32)


def test_irradiance_under_one_lamp() -> None:
    """Black room, one lamp: irradiance below its centre is Lambert's closed form for a rectangle, to 1e-3.

    E = 4 L f with f the form of one quarter a x b at height c: [a/A atan(b/A) + b/B atan(a/B)] / 2, A^2 = c^2 + a^2.
    """
    a, b, c = 0.6, 0.3, 2.0
    big_a, big_b = math.hypot(c, a), math.hypot(c, b)
    expected = 4.0 * 0.5 * (a / big_a * math.atan(b / big_a) + b / big_b * math.atan(a / big_b))
    black = Uniform((0.0, 0.0, 0.0))
    floor = rectangle("floor", (0, 0, 0), (0, 0, 1), (0.12, 0.12), texture=black)
    lamp = rectangle("lamp", (0, 0, c), (0, 0, -1), (2 * a, 2 * b), texture=black, radiance_w_m2_sr=(1.0, 2.0, 3.0))
    room = Room("one lamp", (floor, lamp), (), robot=False)
    result = bake(RIG.at(0.0), room, BakeSettings(texel_m=0.04, lamp_rays=512, bounces=1, bounce_rays=1, final_rays=1))
    centre = result.irradiance_w_m2[4]  # 3 x 3 texels
    assert centre == pytest.approx(expected * np.array([1.0, 2.0, 3.0]), rel=1e-3)


def test_integrating_box() -> None:
    """Closed cube, albedo rho, a fraction of its wall emitting: mean irradiance is E_direct / (1 - rho) on average.

    Energy: every watt that reaches a wall is reflected with rho and reaches a wall again; the flux over all walls is
    the lamps' flux / (1 - rho). The lamp stands 5 mm off the ceiling and absorbs what falls on it (4 % of the ceiling's
    share, under 1 % of all): 1.5 %.
    """
    rho, side = 0.5, 2.0
    grey = Uniform((rho,) * 3)
    places = [((1, 0, 0), (-1, 0, 0)), ((-1, 0, 0), (1, 0, 0)), ((0, 1, 0), (0, -1, 0)), ((0, -1, 0), (0, 1, 0))]
    places += [((0, 0, 1), (0, 0, -1)), ((0, 0, -1), (0, 0, 1))]
    walls = [rectangle(f"w{i}", p, n, (side, side), texture=grey) for i, (p, n) in enumerate(places)]
    lamp = rectangle("lamp", (0, 0, 0.995), (0, 0, -1), (0.2, 0.2), radiance_w_m2_sr=(1.0, 1.0, 1.0))
    room = Room("box", (*walls, lamp), (), robot=False)
    settings = BakeSettings(texel_m=0.1, lamp_rays=64, bounces=20, bounce_rays=64, final_rays=256)
    result = bake(dataclasses.replace(RIG).at(-0.71), room, settings)
    texels = 6 * 20 * 20
    flux = float(np.sum(result.irradiance_w_m2[:texels, 0])) * 0.1**2
    assert flux == pytest.approx(math.pi * 0.2 * 0.2 / (1.0 - rho), rel=0.015)


def test_noise_is_what_two_bakes_differ_by(coarse_light: LightMap) -> None:
    """The stated standard error against the scatter of the halves' mean is honest over the floor, to 10 %."""
    grid = TexelGrid.of(face_table(ROOM.surfaces), COARSE.texel_m)
    part = slice(0, grid.texels_of(1))
    seen = ~coarse_light.covered[part]
    relative = coarse_light.sigma_w_m2[part][seen] / coarse_light.irradiance_w_m2[part][seen]
    assert 0.0 < np.sqrt(np.mean(relative**2)) < 0.02


def test_faces_of_a_cuboid_enclose_it() -> None:
    """Six rectangles whose areas and normals add up: sum of area x normal is 0, volume is sum of (c . n) A / 3."""
    box = cuboid("box", (0.3, -0.2, 0.7), (0.4, 0.5, 0.6), (0.1, 0.2, 0.3))
    sides = faces(box)
    areas = np.array([np.prod(side.size_m) for side in sides])
    normals = np.array([side.T_world_shape.R[:, 2] for side in sides])
    centres = np.array([side.T_world_shape.t for side in sides])
    assert areas @ normals == pytest.approx(np.zeros(3), abs=1e-15)
    assert np.einsum("ni,ni,n->", centres, normals, areas) / 3.0 == pytest.approx(0.4 * 0.5 * 0.6)


def test_patches_tile_their_surfaces() -> None:
    grid = TexelGrid.of(face_table(ROOM.shapes(VIEW)), 0.05)
    parts = [part for part, _, _ in grid.grids()]
    assert [part.start for part in parts] == [0, *(part.stop for part in parts[:-1])]
    assert parts[-1].stop == grid.count
    centres = grid.points()[0]
    assert len(centres) == grid.count
    assert centres[0] == pytest.approx([-4.8 + 0.025, -4.6 + 0.025, 0.0])
    assert centres[1] - centres[0] == pytest.approx([0.05, 0.0, 0.0])  # rows run along local x


def test_texels_lie_in_their_planes() -> None:
    """Also those of faces that are no rectangles: the ends of a prism, triangles of a mesh, which has two sides."""
    rng = np.random.default_rng(0)
    prism = Prism("p", Pose("world", "shape", (0.1, 0.2, 0.3), rotation_xyz(0.3, 0.2, 0.1)), 0.2, 0.4, 9)
    mesh = Mesh("m", rng.normal(size=(9, 3)), np.arange(9).reshape(3, 3), two_sided=True)
    grid = TexelGrid.of(face_table([prism, mesh]), 0.05)
    points, normals = grid.points()
    patch = grid.patch()[0]
    table = grid.table
    assert np.abs(np.einsum("ni,ni->n", points - table.centre_m[patch], table.normal[patch])).max() < 1e-12
    assert np.all(np.abs(table.local_m(patch, points)) < 0.5 * table.size_m[patch])
    back = np.arange(grid.count) >= grid.back[patch]
    turned = np.where((back & table.two_sided[patch])[:, None], -1.0, 1.0) * table.normal[patch]
    np.testing.assert_allclose(normals, turned)


def test_other_rooms_and_cameras_need_no_other_kernels() -> None:
    """Compiling takes longer than a small view: kernels may depend on nothing that varies from view to view."""
    few = BakeSettings(texel_m=0.5, lamp_rays=4, bounces=2, bounce_rays=8, final_rays=16)
    bare = dataclasses.replace(ROOM, furniture=ROOM.furniture[:3])
    camera = dataclasses.replace(RIG.camera, fx_px=1500.0, cx_px=600.0)
    first = _kernels(few, ROOM, RIG)
    assert len(first) >= 5
    assert _kernels(dataclasses.replace(few, bounce_rays=12), bare, dataclasses.replace(RIG, camera=camera)) <= first
    rough = dataclasses.replace(RIG, mirror=dataclasses.replace(RIG.mirror, roughness_alpha=0.01))
    assert not _kernels(few, ROOM, rough) <= first  # the test can tell


def _kernels(settings: BakeSettings, room: Room, rig: Rig) -> set[str]:
    """Hashes of the kernels of a bake and of a part of a view."""
    from phibench.render.setup.variant import activate

    activate()
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        render_ambient(rig.at(0.3), room, bake(rig.at(0.0), room, settings), settings, 2, 1, (690, 430, 48, 48))
        found = {str(kernel["hash"]) for kernel in dr.kernel_history([dr.KernelType.JIT])}
        dr.kernel_history_clear()
    return found
