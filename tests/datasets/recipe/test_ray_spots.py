"""Spots by rays: what carries one, what does not and why, and how beams go through recipe and manifest."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from helpers.drawn_values import RAY, drawing

from phibench.datasets.build.spot_task import answer_spot, manifest_row
from phibench.datasets.common.errors import RecipeError
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.read import Dataset, Sample
from phibench.datasets.recipe.load import check_recipe
from phibench.datasets.recipe.spot_placement import by_ray
from phibench.datasets.recipe.tables import LaserTable, Recipe
from phibench.datasets.rooms.room_sources import room_of
from phibench.datasets.store.schema import ManifestRow, SpotRow
from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.laser import LaserSpot
from phibench.scenes.room import Room, default_rig
from phibench.scenes.shapes import Bitmap, Cuboid, Mesh, Prism, Rectangle, Shape, Uniform, rectangle

OWN, DISC = LaserTable(albedo="surface"), LaserTable()
BLACK = Uniform((0.03, 0.03, 0.03))
SHINING = np.full((4, 4, 4), 2.0, dtype=np.float32)


def card(name: str = "card", normal: tuple[float, ...] = (-1.0, 0.0, 0.0), **options: Any) -> Rectangle:
    return rectangle(name, (2.0, 0.0, 0.7), normal, (1.0, 1.0), **options)


def one(laser: LaserTable, *shapes: Shape, elevation_deg: float = 0.0, height_m: float = 0.7) -> LaserSpot | str:
    """Spot of one ray along x, or why there is none."""
    [found] = by_ray(laser, Room("r", (), shapes), np.array([0.0]), np.array([height_m]), np.array([elevation_deg]))
    return found if isinstance(found, str) else found[1]


def bitmap(own_albedo: float) -> Bitmap:
    values = SHINING.copy()
    values[..., 3] = own_albedo
    return Bitmap(values, (0.1, 0.1), is_radiance=True)


REFUSED: dict[str, tuple[tuple[Shape, ...], str]] = {
    "nothing": ((), "meets nothing"),
    "lamp": ((card("lamp_3", radiance_w_m2_sr=(1.0, 1.0, 1.0)),), "lamp_3, a lamp"),
    "window": ((card("pane", window=True),), "pane, a window"),
    "screen": ((card("monitor", texture=bitmap(0.0)),), "monitor, a screen"),
    "glossy black": ((card("lid", texture=BLACK, coat=1.5),), "lid, which is like a mirror"),
    "back": ((card("poster", normal=(1.0, 0.0, 0.0)),), "the back of poster"),
    "inside": ((Cuboid("crate", Pose("world", "shape", (0.0, 0.0, 0.7)), (1.0, 1.0, 1.0)),), "the back of crate"),
    "near": ((Cuboid("leg", Pose("world", "shape", (0.3, 0.0, 0.7)), (0.1, 0.1, 0.1)),), "nearer than 0.3 m"),
}


@pytest.mark.parametrize("laser", [OWN, DISC], ids=["own", "disc"])
@pytest.mark.parametrize("case", REFUSED)
def test_what_carries_no_spot(laser: LaserTable, case: str) -> None:
    shapes, reason = REFUSED[case]
    found = one(laser, *shapes)
    assert isinstance(found, str)
    assert reason in found
    assert "\n" not in found


def test_what_carries_one() -> None:
    """Matt black, a varnished board, a photographed wall whose albedo is stated, both sides of a two-sided mesh."""
    leaf = Mesh("leaf", np.array([[2.0, -1, 0], [2, 1, 0], [2, 0, 2]]), np.array([[0, 1, 2]]), two_sided=True)
    for shape in (card(texture=BLACK), card(coat=1.5), card(texture=bitmap(0.5)), leaf):
        spot = one(OWN, shape)
        assert isinstance(spot, LaserSpot), spot
        assert spot.albedo is None
        assert spot.beam_direction_world == (1.0, 0.0, 0.0)
        assert spot.position_world_m == pytest.approx((2.0, 0.0, 0.7))
        assert spot.normal_world == pytest.approx((-1.0, 0.0, 0.0))
        assert spot.diameter_m == pytest.approx(5e-3)


def test_curved_things_and_edges_carry_beams_but_no_discs() -> None:
    """A beam may be cut by an edge 0.2 m before a wall; with 0.3 m it would be two spots. A disc needs one face."""
    post = Prism("post", Pose("world", "shape", (2.0, 0.0, 0.7), rotation_xyz(z_rad=0.1)), 0.02, 1.0, 24)
    assert isinstance(one(OWN, post, rectangle("wall", (2.2, 0, 0.7), (-1, 0, 0), (1, 1))), LaserSpot)
    for gap_m, fits in ((0.2, True), (0.3, False)):
        edge = Cuboid("box", Pose("world", "shape", (2.1, 0.499, 0.7)), (0.2, 1.0, 1.0))
        found = one(OWN, edge, rectangle("wall", (2.0 + gap_m, 0, 0.7), (-1, 0, 0), (3, 3)))
        assert isinstance(found, LaserSpot) is fits
        assert fits or "split between box" in cast(str, found)
        refused = one(DISC, edge, rectangle("wall", (2.0 + gap_m, 0, 0.7), (-1, 0, 0), (3, 3)))
        assert isinstance(refused, str)
        assert "wholly on box" in refused


def test_rays_may_rise_and_fall() -> None:
    """Down by 30 degrees from 0.7 m: on the floor at 0.7 / tan 30; the diameter grows with the length of the ray."""
    floor = rectangle("floor", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (9.0, 9.0))
    spot = one(OWN, floor, elevation_deg=-30.0)
    assert isinstance(spot, LaserSpot)
    assert spot.position_world_m == pytest.approx((0.7 / math.tan(math.radians(30.0)), 0.0, 0.0), abs=1e-12)
    assert spot.diameter_m == pytest.approx(3e-3 + 1e-3 * 1.4)
    assert one(OWN, floor, elevation_deg=-80.0) == "the ray meets floor nearer than 0.3 m to the axis"


def test_a_recipe_of_beams_is_drawn_and_read_back() -> None:
    """Spots of the plan, and of the rows that are written and read, are the same beams; a disc's rows have none."""
    spot_table = {**RAY, "elevation_deg": {"uniform": [-20, 30]}}
    raw = {**drawing(samples=40, spot=spot_table), "laser": {"albedo": "surface"}}
    plan = make_plan(check_recipe(raw))
    rises = {round(float(dict(pair.drawn)["spot.elevation_deg"])) for pair in plan.pairs}
    assert min(rises) < -15
    assert max(rises) > 25
    for pair in plan.pairs[:2]:
        spot = plan.spots[pair.spot]
        assert spot.albedo is None
        assert spot.beam_direction_world is not None
        assert read_back(plan.recipe, row_of(spot, pair)) == spot
    flat = make_plan(check_recipe(drawing(samples=2, spot=RAY)))
    row = row_of(flat.spots[flat.pairs[0].spot], flat.pairs[0])
    assert row.spot_beam_world is None
    assert read_back(flat.recipe, row) == flat.spots[flat.pairs[0].spot]


def row_of(spot: LaserSpot, pair: Any) -> ManifestRow:
    side = SpotRow.model_construct(visible=False)
    return manifest_row(default_rig(), spot, pair, side, side)


def read_back(recipe: Recipe, row: ManifestRow) -> LaserSpot:
    dataset = cast(Dataset, SimpleNamespace(recipe=recipe))
    return Sample(dataset, row).laser_spot


def test_beams_of_the_lab_are_certified() -> None:
    """Both views of drawn spots on the lab's textured surfaces: each visible one has a certificate that passes."""
    raw = {**drawing(samples=6, spot=RAY), "laser": {"albedo": "surface"}}
    plan, seen = make_plan(check_recipe(raw)), 0
    [room] = (room_of(source) for source in plan.rooms.values())
    for pair in plan.pairs:
        answer = answer_spot(plan.view(pair, "down"), plan.spots[pair.spot], room)
        if answer.certificate is not None:
            assert answer.certificate.passed
            seen += 1
    assert seen >= 4


def test_an_elevation_needs_the_ray_and_an_albedo_is_a_number_or_the_surfaces_own() -> None:
    with pytest.raises(RecipeError, match=r"spot\.azimuth_deg.*missing; elevation_deg needs it"):
        check_recipe(drawing(spot={"elevation_deg": 3.0}))
    with pytest.raises(RecipeError, match=r"laser\.albedo"):
        check_recipe({**drawing(), "laser": {"albedo": "paper"}})
