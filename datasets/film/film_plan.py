"""Plan of a recipe's films, one for each pair: moving scene by `[film]`, image region to render, count of key views."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from phibench.datasets.common.errors import DatasetError, RecipeError
from phibench.datasets.plan.plan import PairPlan, Plan, make_plan
from phibench.datasets.recipe.film_tables import FilmLightTable, FilmTable
from phibench.datasets.recipe.recipe_scene import spot_albedo
from phibench.datasets.recipe.spot_placement import by_ray
from phibench.datasets.recipe.tables import OWN_ALBEDO, LaserTable, Recipe
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.render.film.key_views import PoseParts
from phibench.render.film.moving_rows import chief_uv_px
from phibench.render.sensor.light import Region
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.motion.carriage import Carriage, Encoder, Vibration
from phibench.scenes.motion.drive import Drive, DriveLeg
from phibench.scenes.motion.film_scene import FilmLight, FilmScene, SpotPath, Waypoint, frame_count
from phibench.scenes.motion.film_times import BlinkCode, FilmTimes
from phibench.scenes.motion.vehicle import Vehicle
from phibench.scenes.room import Room
from phibench.scenes.validation import SceneError

TILE_PX = 32  # of the noise: a region of whole tiles has the pixels of the frame
MARGIN_PX = 20  # a JPEG's unit and what demosaicing looks at, around a window
KEY_PX, DRIVE_KEY_PX = 1.2, 1.8  # motion of the spot's image from key view to key view, before the proof is asked
_SAMPLES = 257  # instants of a leg: the image's way is summed between them
_CEILING_M = 2.6  # of a usual room: the highest places that move in the image
_DISC_ALBEDO = 0.5  # of a light, where the laser's spot takes that of the surface


@dataclass(frozen=True)
class FilmPlan:
    """One film.

    Attributes
    ----------
    film_id : str
        That of its pair.
    scene, nominal : FilmScene
        True one, and what an estimator may know: nominal rig, stroke and carriage, no vibration.
    names : tuple
        Data set, seed, film: the beginning of its random streams.
    region : Region
        Part of the image that is rendered.
    window_px : int or None
        Side of the square around the spot; None where whole images are made.
    keys : tuple of int
        Key views to begin with, of each part of the poses (`PoseParts`).
    """

    film_id: str
    pair: PairPlan
    scene: FilmScene
    nominal: FilmScene
    encoder: Encoder
    names: tuple[str, int, str]
    region: Region
    window_px: int | None
    keys: tuple[int, ...]

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the image."""
        return self.scene.rig.camera.height_px, self.scene.rig.camera.width_px


def film_plans(recipe: Recipe, files: RoomFiles | None = None) -> tuple[Plan, tuple[FilmPlan, ...]]:
    """Plan of the recipe's pairs, and of their films.

    Raises
    ------
    RecipeError
        If the recipe has no `[film]`, or what it says cannot be filmed.
    """
    if recipe.film is None:
        raise RecipeError(f"recipe {recipe.dataset.name} has no [film]; add the table, [film] alone takes the defaults")
    plan = make_plan(recipe, files)
    return plan, tuple(_film(plan, recipe.film, pair) for pair in plan.pairs)


def _film(plan: Plan, table: FilmTable, pair: PairPlan) -> FilmPlan:
    names = (plan.recipe.dataset.name, plan.recipe.dataset.seed, pair.sample_id)
    try:
        scene = film_scene(plan, table, pair)
        nominal = nominal_scene(plan, scene, pair, table)
    except SceneError as error:
        raise RecipeError(f"film {pair.sample_id}: {error}") from error
    size = scene.rig.camera.height_px, scene.rig.camera.width_px
    uv = spot_track_px(scene)
    if not np.isfinite(uv).all():
        raise DatasetError(
            f"film {pair.sample_id}: the mirror shows the spot at {np.isfinite(uv).all(axis=1).mean():.0%} of the "
            "times only; a target must have an image all the time: move it, or shorten the stroke or the drive"
        )
    whole = table.view == "full"
    region = Region.whole(size) if whole else _around(uv, table.window_px, size, pair.sample_id)
    encoder = Encoder(table.encoder_rms_m, table.encoder_step_m)
    window = None if whole else table.window_px
    return FilmPlan(pair.sample_id, pair, scene, nominal, encoder, names, region, window, _keys(scene, uv, whole))


def film_scene(plan: Plan, table: FilmTable, pair: PairPlan) -> FilmScene:
    """True scene of a pair's film."""
    rig = plan.rigs[pair.rig]
    carriage = _carriage(table, pair.stroke_m)
    height = rig.camera.height_px
    seed = plan.recipe.dataset.name, plan.recipe.dataset.seed, pair.sample_id
    drive = _drive(table, carriage, seed)
    frames = frame_count(carriage, table.rate_hz, drive) if table.frames is None else table.frames
    times = FilmTimes(frames, table.rate_hz, table.exposure_s, table.readout_s, height)
    bands = tuple(
        Vibration.band(band.axis, band.low_hz, band.high_hz, band.rms_m, *seed, number)
        for number, band in enumerate(table.vibration)
    )
    path = SpotPath(tuple(Waypoint(*row) for row in table.path))
    code = BlinkCode(table.code, table.bit_s, table.code_start_s)
    lights = _lights(plan, table, pair, code)
    return FilmScene(rig, plan.spots[pair.spot], times, carriage, bands, path, code, lights, drive, pair.stroke_m)


def _lights(plan: Plan, table: FilmTable, pair: PairPlan, code: BlinkCode) -> tuple[FilmLight, ...]:
    """Other lights of a film."""
    if not table.lights:
        return ()  # no room need be built
    room, laser = plan.room(pair.room), plan.recipe.laser
    if laser.albedo == OWN_ALBEDO:  # a light is a disc, which may move; a beam's spot stays where it ends
        laser = laser.model_copy(update={"albedo": _DISC_ALBEDO})
    return tuple(_light(laser, room, light, code) for light in table.lights)


def _light(laser: LaserTable, room: Room, table: FilmLightTable, code: BlinkCode) -> FilmLight:
    azimuth, elevation = np.array([table.azimuth_deg]), np.array([table.elevation_deg])
    if table.distance_m is None:
        [found] = by_ray(laser, room, azimuth, np.array([table.height_m]), elevation)
        if isinstance(found, str):
            raise SceneError(f"light '{table.name}': {found}; give another direction, or distance_m")
        spot = found[1]
    else:
        turn, rise = np.radians(azimuth[0]), np.radians(elevation[0])
        ray = np.array([math.cos(turn) * math.cos(rise), math.sin(turn) * math.cos(rise), math.sin(rise)])
        place = np.array([0.0, 0.0, table.height_m]) + table.distance_m * ray
        if room.solid_around(as_vector(place)) is not None:
            raise SceneError(f"light '{table.name}' lies within the room's things; give another distance_m")
        diameter = laser.diameter_base_m + laser.diameter_growth_m_per_m * table.distance_m
        albedo = spot_albedo(laser.albedo, None) or _DISC_ALBEDO
        spot = LaserSpot(as_vector(place), as_vector(-ray), diameter, albedo, laser.power_w, laser.wavelength_nm)
    spot = replace(spot, power_w=table.power_ratio * laser.power_w, diameter_m=table.diameter_m or spot.diameter_m)
    own = code if table.follows_laser else BlinkCode(table.code, table.bit_s, table.code_start_s)
    path = SpotPath(tuple(Waypoint(*row) for row in table.path))
    return FilmLight(table.name, spot, path, own, table.colour, table.follows_laser, table.is_target)


def nominal_scene(plan: Plan, scene: FilmScene, pair: PairPlan, table: FilmTable) -> FilmScene:
    """Scene as an estimator may take it to be: it knows neither vibration, nor the paths of target and robot."""
    rig, carriage = plan.rigs[pair.nominal_rig], _carriage(table, pair.nominal_stroke_m)
    known = replace(scene, rig=rig, carriage=carriage, stroke_m=pair.nominal_stroke_m)
    return replace(known, vibrations=(), path=SpotPath(), lights=(), drive=None)


def _carriage(table: FilmTable, stroke_m: float) -> Carriage:
    stops = tuple(share * stroke_m for share in table.stops)
    return Carriage(stops, table.pauses_s, table.speed_m_per_s, table.acceleration_m_per_s2)


def _drive(table: FilmTable, carriage: Carriage, names: tuple[str, int, str]) -> Drive | None:
    """Drive whose legs follow each other, the first one after the carriage's last move, unless they have times."""
    if not table.drive:
        return None
    drive, legs, now = Drive(Vehicle(), (), 0.0, 1.0), [], carriage.duration_s
    for row in table.drive:
        flipper = None if row.flipper_deg is None else _flipper_rad(row.flipper_deg)
        start, turn = now if row.start_s is None else row.start_s, math.radians(row.turn_deg)
        legs.append(DriveLeg(start, row.length_m, turn, flipper, row.speed_m_per_s, row.acceleration_m_per_s2))
        drive = Drive.drawn(Vehicle(), legs, *names)
        now = drive.end_s
    return drive


def _flipper_rad(angle_deg: float) -> float:
    low, high = (math.degrees(Vehicle().flipper_low_rad), math.degrees(Vehicle().flipper_high_rad))
    if not low <= angle_deg <= high:
        raise SceneError(f"flipper_deg = {angle_deg:g}: the flippers turn from {low:.1f} to {high:.1f} deg; give less")
    return math.radians(angle_deg)


def spot_track_px(scene: FilmScene) -> Array:
    """Image of the spot's centre at 257 times of a film, and at all its frames, shape (N, 2)."""
    times = scene.times
    half = 0.5 * (times.exposure_s + times.readout_s)
    dense = np.linspace(times.frame_s[0] - half, times.frame_s[-1] + half, _SAMPLES)
    return chief_uv_px(scene, np.concatenate([dense, times.frame_s]))


def _around(uv: Array, side_px: int, size: tuple[int, int], film_id: str) -> Region:
    """Whole tiles around all windows of a film."""
    height, width = size
    outside = (uv[:, 0] < -0.5) | (uv[:, 0] > width - 0.5) | (uv[:, 1] < -0.5) | (uv[:, 1] > height - 0.5)
    if outside.any():
        u, v = uv[np.flatnonzero(outside)[0]]
        raise DatasetError(
            f"film {film_id}: the spot leaves the image, at ({u:.1f}, {v:.1f}) px; move the target, or shorten the "
            "stroke or the drive"
        )
    windows = [Region.around(float(u), float(v), size, min(side_px, *size)) for u, v in uv]
    box = Region(
        min(w.u0_px for w in windows),
        min(w.v0_px for w in windows),
        max(w.u1_px for w in windows),
        max(w.v1_px for w in windows),
    )
    return box.grown(size, (TILE_PX, TILE_PX), (MARGIN_PX, MARGIN_PX))


def _keys(scene: FilmScene, uv: Array, whole: bool) -> tuple[int, ...]:
    """Number of key views of each part at which the image moves by about `KEY_PX` from one to the next.

    On a leg of the drive that is the image of the spot; in whole images, that of any place around the robot.
    """
    parts = PoseParts.of(scene).parts
    counts = []
    for number, part in enumerate(parts):
        if part.high - part.low < 1e-9:  # a carriage that rests: one view
            counts.append(1)
            continue
        if scene.drive is None:
            way = float(np.linalg.norm(uv.max(axis=0) - uv.min(axis=0)))
        else:
            end = parts[number + 1].start_s if number + 1 < len(parts) else scene.times.duration_s
            times = np.linspace(part.start_s, max(end, part.start_s + 1e-3), _SAMPLES)  # a part may have no length
            way = max(_way_px(one, times) for one in (_surroundings(scene) if whole else (_quiet(scene),)))
        apart = KEY_PX if part.leg is None else DRIVE_KEY_PX  # of a turn, all of the window moves alike
        counts.append(max(4, math.ceil(way / apart) + 1))
    return tuple(counts)


def _quiet(scene: FilmScene) -> FilmScene:
    return replace(scene, vibrations=(), path=SpotPath(), lights=())


def _surroundings(scene: FilmScene) -> Iterator[FilmScene]:
    """Films of places as far away as the spot, all around, at its height and near the ceiling."""
    here, spot = scene.rig.T_world_camera.t, np.array(scene.spot.position_world_m)
    distance = float(np.linalg.norm((spot - here)[:2]))
    # eight directions: on a leg, the fastest places are ahead or aside
    for turn in np.arange(0.0, 2.0 * np.pi, 0.25 * np.pi):
        for height in (float(spot[2]), _CEILING_M):
            place = np.array([here[0] + distance * np.cos(turn), here[1] + distance * np.sin(turn), height])
            point = replace(scene.spot, position_world_m=as_vector(place), beam_direction_world=None)
            yield replace(_quiet(scene), spot=point)


def _way_px(scene: FilmScene, times_s: Array) -> float:
    """Way of the spot's image, where there is one."""
    return float(np.nansum(np.linalg.norm(np.diff(chief_uv_px(scene, times_s), axis=0), axis=1)))
