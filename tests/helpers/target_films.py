"""Films of whole frames with a target among other lights, drawn in rooms that are rendered once.

A room's light, path-traced, comes from a film of the room. Every film of the study has a target and other lights of its
own: places on what rays from the robot meet, exact images of `render.film` with rolling shutter and code, and the noise
of the real chain. The light of the target is scaled so that its flux, at a known place, is known to 1 / `sigma` of
itself from one frame in which it is on.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from helpers.simple_targets import ColourIdentity, NearestBlob, red_blobs
from numpy.typing import NDArray
from scipy.optimize import brentq

from phibench.datasets.film.film_plan import FilmPlan, film_plans
from phibench.datasets.film.film_read import film_light
from phibench.datasets.film.film_room import renderer
from phibench.datasets.film.film_task import coloured_image, frame_spots
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.plan.plan import Plan
from phibench.datasets.recipe.load import parse_recipe
from phibench.datasets.recipe.spot_placement import by_ray
from phibench.estimator.spots.detect import mirror_box, outline_mask
from phibench.render.film.key_views import PoseParts, blended
from phibench.render.film.moving_rows import RowsImage, chief_uv_px, spot_time_s
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream, mosaic
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import sensor
from phibench.robot.film.target_tracker import TargetCode, TargetTracker
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.motion.carriage import Carriage
from phibench.scenes.motion.film_scene import FilmLight, FilmScene, SpotPath, Waypoint
from phibench.scenes.motion.film_times import BlinkCode, FilmTimes
from phibench.scenes.random_streams import generator
from phibench.scenes.room import Room

CODE = "111100010011010"
CODES = ((CODE, 0), (CODE, 5), ("000111011001011", 0), ("000111011001011", 7))
"""Codes of up to four targets, with their delays in bits: any two agree in at most 9 of 15 bits."""
RATE_HZ = 30.0
APART_PX = 12.0  # of lights from the target: nearer ones share its pixels
KINDS = ("lamp", "reflection", "red object", "other laser", "drifting")
Hidden = Mapping[int, range]
"""Frames in which lights are hidden, by their numbers: 0 is the first target."""
_TRIES = 200
_READ_E2 = 4.0**2


@dataclass(frozen=True)
class RenderedRoom:
    """Views of a room, path-traced: plans of the film that they belong to, offsets, and views (keys, 3, H, W)."""

    plan: FilmPlan
    recipe: Plan
    keys_m: Array
    views: NDArray[np.float32] = field(repr=False)

    @property
    def room(self) -> Room:
        """Surfaces and furniture."""
        return self.recipe.room(self.plan.pair.room)


def rendered_rooms(text: str, keys_m: Sequence[float], kept: Path, most: int | None = None) -> list[RenderedRoom]:
    """Rooms of a recipe, at most so many, rendered into a folder, or read from there."""
    recipe, films = film_plans(parse_recipe(text))
    rooms = []
    for film in films[:most]:
        path = kept / f"{film.film_id}.npy"
        if not path.exists():
            render = renderer(recipe, film, recipe.room(film.pair.room))
            kept.mkdir(parents=True, exist_ok=True)
            np.save(path, np.stack([render(film.scene.rig.at(h), (0, h), 17 + n) for n, h in enumerate(keys_m)]))
        rooms.append(RenderedRoom(film, recipe, np.array(keys_m), np.load(path)))
    return rooms


@dataclass(frozen=True)
class StagedFilm:
    """Film of whole frames.

    Attributes
    ----------
    scene : FilmScene
        With its other lights, at their drawn places.
    rendered : RenderedRoom
    images : list of lists of RowsImage
        Of the target, and of each light, in every frame, at their final brightness.
    uv_px : array, shape (lights + 1, frames, 2)
        True places, the target's first.
    kinds : tuple of str
    region : Region
        Part of the image around the mirror.
    names : tuple
        Of the noise's streams.
    """

    scene: FilmScene
    rendered: RenderedRoom = field(repr=False)
    images: list[list[RowsImage]] = field(repr=False)
    uv_px: Array = field(repr=False)
    kinds: tuple[str, ...]
    region: Region
    names: tuple[Any, ...]
    preset: str = "bayer-raw"

    @property
    def codes(self) -> list[BlinkCode]:
        """Codes of the targets, which come first among the lights."""
        return [self.scene.code, *(one.code for one in self.scene.lights if one.is_target)]

    def light(self, frame: int, hidden: Hidden = MappingProxyType({})) -> Light:
        """Light of a frame; what is hidden is left out, as by an opaque thing in front of it."""
        nothing = RowsImage(0, 0, *np.zeros((3, 3, 0, 0)))
        own = [
            nothing if frame in hidden.get(number, ()) else images[frame] for number, images in enumerate(self.images)
        ]
        return film_light(self.scene, self.room(frame), own[0], own[1:])

    def room(self, frame: int) -> NDArray[np.float32]:
        """Room in a frame, shape (3, H, W), electrons per second; without a stroke it is the same in all."""
        views, keys = self.rendered.views, self.rendered.keys_m
        if len(keys) == 1:
            return np.asarray(views[0])
        rows = np.arange(views.shape[2]).astype(float)
        return blended(views, PoseParts.of(self.scene).row_weights([keys], frame, rows))

    def frames(self, hidden: Hidden = MappingProxyType({})) -> Iterator[NDArray[Any]]:
        """Camera frames, black outside of the mirror's box; lights are hidden in some frames, by their number."""
        times = self.scene.times
        chosen = sensor(self.preset, exposure_s=times.exposure_s, readout_s=times.readout_s)
        chain = Chain(chosen, 0, self.scene.rig.camera)
        for k in range(times.frames):
            stream = NoiseStream((*self.names, "frame", k))
            part = chain.frame(self.light(k, hidden), stream, self.region)
            image = np.zeros((*self.rendered.views.shape[2:], *part.shape[2:]), part.dtype)
            image[self.region.slices()] = part
            yield image


def staged(
    rendered: RenderedRoom,
    names: Sequence[Any],
    sigma: float,
    distractors: int,
    frames: int,
    kinds: Sequence[str] = KINDS,
    carriage: Carriage | None = None,
    walk_m_per_s: float = 0.0,
    rate_hz: float = RATE_HZ,
    targets: int = 1,
) -> StagedFilm:
    """Draw a film in a rendered room; the carriage rests where none is given, the target walks at most so fast."""
    rng = generator(*names, "staged")
    rig = rendered.plan.scene.rig
    size = rig.camera.height_px, rig.camera.width_px
    box = mirror_box(rig)
    region = Region(box.u0_px, box.v0_px, box.u0_px + box.width_px, box.v0_px + box.height_px)
    times = FilmTimes(frames, rate_hz, 1 / 60, 0.030, size[0])
    bit = 1.0 / rate_hz
    code = BlinkCode(CODE, bit, float(rng.uniform(0.0, len(CODE) * bit)))
    scene = replace(rendered.plan.scene, times=times, code=code, vibrations=(), path=SpotPath(), lights=())
    scene = scene if carriage is None else replace(scene, carriage=carriage)
    light = rendered.views[0]
    spots = [_target(scene, rendered, light, rng)]
    lights: list[FilmLight] = []
    chosen = ["target"] * (targets - 1) + [kinds[n % len(kinds)] for n in range(distractors)]
    for number, kind in enumerate(chosen):
        if kind == "target":
            spots.append(_target(scene, rendered, light, rng, spots))
            bits, delay = CODES[number + 1]
            own = BlinkCode(bits, bit, code.start_s + delay * bit)
            lights.append(FilmLight(f"target {number + 1}", spots[-1], code=own, is_target=True))
            continue
        spots.append(_visible_spot(scene, rendered, spots, rng))
        lights.append(_other(kind, number, spots[-1], code, bit, rng))
    way = walk_m_per_s * rng.uniform(-1.0, 1.0, 2)
    walk = SpotPath((Waypoint(0.0, 0.0, 0.0), Waypoint(60.0, *map(float, 60.0 * way))) if walk_m_per_s else ())
    scene = replace(scene, spot=spots[0], lights=tuple(lights), path=walk)
    images, uv = _images(rendered, scene)
    for n in range(targets):
        factor = _factor(scene, spots[n], light, sigma)
        images[n] = [_times(one, factor) for one in images[n]]
    flux = _flux(images[0])
    for n, (kind, own) in enumerate(zip(chosen, images[1:], strict=True), start=1):
        if kind == "target":
            continue
        low, high = (0.1, 0.5) if kind == "reflection" else (0.3, 3.0)
        ratio = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        images[n] = [_times(one, ratio * flux / _flux(own)) for one in own]
    return StagedFilm(scene, rendered, images, uv, tuple(chosen), region, tuple(names))


def _target(
    scene: FilmScene,
    rendered: RenderedRoom,
    light: Array,
    rng: np.random.Generator,
    others: Sequence[LaserSpot] = (),
) -> LaserSpot:
    """Place of the target that is not on a lamp: there the camera's pixels are full, and no light can be added."""
    for _ in range(_TRIES):
        spot = _visible_spot(scene, rendered, others, rng)
        u, v = (round(float(x)) for x in _uv(scene, spot))
        if scene.times.exposure_s * light[:, v - 4 : v + 5, u - 4 : u + 5].max() < 8000.0:
            return spot
    raise AssertionError("no place for the target")


def _visible_spot(
    scene: FilmScene, rendered: RenderedRoom, others: Sequence[LaserSpot], rng: np.random.Generator
) -> LaserSpot:
    laser, room = rendered.recipe.recipe.laser, rendered.room
    view = scene.view_at(0.0)
    taken = [_uv(scene, one) for one in others]
    inside = outline_mask(scene.rig, box := mirror_box(scene.rig))
    for _ in range(_TRIES):
        azimuth, height, rise = rng.uniform(0.0, 360.0), rng.uniform(0.3, 1.0), rng.uniform(-8.0, 20.0)
        [found] = by_ray(laser, room, np.array([azimuth]), np.array([height]), np.array([rise]))
        if isinstance(found, str):
            continue
        spot = found[1]
        if not spot_truth(view, spot, room_geometry(room, view)).visible:
            continue
        uv = _uv(scene, spot)
        u, v = (round(float(x)) for x in uv)
        low, high = (box.u0_px + 12, box.v0_px + 12), (box.width_px - 24, box.height_px - 24)
        if not (0 <= u - low[0] < high[0] and 0 <= v - low[1] < high[1] and inside[v - box.v0_px, u - box.u0_px]):
            continue
        if all(np.linalg.norm(uv - one) > APART_PX for one in taken):
            return spot
    raise AssertionError("no place for a light")


def _uv(scene: FilmScene, spot: LaserSpot) -> Array:
    alone = replace(scene, spot=spot, path=SpotPath(), lights=())
    return np.asarray(chief_uv_px(alone, np.zeros(1))[0])


def _other(kind: str, number: int, spot: LaserSpot, code: BlinkCode, bit: float, rng: np.random.Generator) -> FilmLight:
    """Another light: steady, with the target's code, with another one, or moving."""
    name = f"{kind} {number}"
    if kind == "reflection":
        return FilmLight(name, spot, code=code, follows_laser=True)
    if kind == "other laser":
        bits = ("10", "1100101", CODE, "".join(map(str, rng.integers(0, 2, 15))))[int(rng.integers(4))]
        bits = bits if "1" in bits else "1" + bits[1:]
        apart = 10.0 * bit  # the target's own code comes at another time, which is no other target's
        return FilmLight(name, spot, code=BlinkCode(bits, bit, code.start_s + apart))
    if kind == "lamp":
        return FilmLight(name, spot, colour=(1.0, 1.1, 0.8))
    if kind == "red object":
        return FilmLight(
            name, replace(spot, diameter_m=float(rng.uniform(0.01, 0.03)), profile="uniform"), colour=(1.0, 0.3, 0.2)
        )
    way = rng.uniform(-0.25, 0.25, 2)
    return FilmLight(name, spot, SpotPath((Waypoint(0.0, 0.0, 0.0), Waypoint(1.0, *map(float, way)))))


def _images(rendered: RenderedRoom, scene: FilmScene) -> tuple[list[list[RowsImage]], Array]:
    """Images and places of the target and of every other light."""
    images, places = [], []
    for n in range(len(scene.lights) + 1):
        alone = replace(scene, lights=()) if n == 0 else scene.of_light(n - 1)
        times = [spot_time_s(alone, k) for k in range(alone.times.frames)]
        plan = replace(rendered.plan, scene=alone)
        own, _ = frame_spots(plan, rendered.room, times)
        colour = None if n == 0 else scene.lights[n - 1].colour
        if colour is not None:
            own = [coloured_image(one, colour) for one in own]
        images.append(own)
        places.append(chief_uv_px(alone, np.array(times)))
    return images, np.array(places)


def _times(image: RowsImage, factor: float) -> RowsImage:
    stacks = (image.electrons_per_s, image.du_electrons_per_s_px, image.dv_electrons_per_s_px)
    return RowsImage(image.u0_px, image.v0_px, *(factor * stack for stack in stacks))


def _flux(images: Sequence[RowsImage]) -> float:
    """Largest electrons per second of a frame, of the brightest filter."""
    return max(float(one.electrons_per_s.sum(axis=(1, 2)).max(initial=0.0)) for one in images)


def _factor(scene: FilmScene, spot: LaserSpot, room: Array, sigma: float) -> float:
    """Factor of a target's light at which a frame with the laser on knows its flux to 1 / sigma."""
    view = scene.view_at(0.0)
    layer = spot_layer(view, spot, ())  # always on, and at rest
    height, width = layer.electrons_per_s.shape[1:]
    window = (slice(layer.v0_px, layer.v0_px + height), slice(layer.u0_px, layer.u0_px + width))
    phase = (layer.v0_px, layer.u0_px)
    T = scene.times.exposure_s
    s = T * mosaic(np.maximum(layer.electrons_per_s, 0.0), phase)
    b = T * mosaic(room[(slice(None), *window)].astype(float), phase)

    def excess(log_factor: float) -> float:
        f = np.exp(log_factor)
        return float(np.sum((f * s) ** 2 / (f * s + b + _READ_E2))) - sigma**2

    return float(np.exp(brentq(excess, -25.0, 10.0)))


# -- outcome -----------------------------------------------------------------------------------------------------------

ON_IT_PX = 3.0  # of a place from the target
_OTHERS_PX = 6.0  # around other targets: simple ways are not shown what lies there


@dataclass(frozen=True)
class Outcome:
    """Outcome of one way to find a target, in one film.

    Attributes
    ----------
    way : str
        "code", "colour", "blob", or "told blob", which is told the true place in the first frame.
    sigma, lights : float and int
        Of the film.
    film, target : int
    first : int
        Frame at which it first says where the target is; -1 for never.
    right : bool
        At that frame; of simple ways after half a second, because they change their minds.
    asked : int
        1 where it is on the target after half a second, 0 where it says nothing, -1 where it is on something else.
    last : int
        The same in the last frame.
    losses : int
    again : int
        Frame of the first lock after a loss; -1 where there is none.
    """

    way: str
    sigma: float
    lights: int
    film: int
    target: int
    first: int
    right: bool
    asked: int
    last: int
    losses: int = 0
    again: int = -1


def followed(
    film: StagedFilm, cell: tuple[float, int, int], asked: int = 14, hidden: Hidden = MappingProxyType({})
) -> list[Outcome]:
    """Outcomes of all ways in a film; `cell` is its sigma, its number of lights, and its own number.

    A film without hidden targets ends where all of them are locked, but not before the frame `asked`. Simple ways look
    for each target by itself, and are not shown the others, which nothing would tell from it.
    """
    rig, card = film.scene.rig, card_of(sensor(film.preset, exposure_s=1 / 60, readout_s=0.03))
    codes = [TargetCode(str(n), code) for n, code in enumerate(film.codes)]
    tracker = TargetTracker(rig, card, film.scene.times, codes)
    search, count = tracker.tracker.search, len(codes)
    colour = ColourIdentity(search, rig.camera.detector.laser_filter_response)
    blobs, told = [NearestBlob() for _ in codes], [NearestBlob(film.uv_px[n, 0]) for n in range(count)]
    places: list[list[tuple[Array | None, ...]]] = []
    for k, image in enumerate(film.frames(hidden)):
        tracker.add(image)
        colour.add(tracker.tracker.planes, tracker.tracker.live)
        found = red_blobs(tracker.tracker.planes, search)
        now: list[tuple[Array | None, ...]] = []
        for n in range(count):
            others = np.delete(film.uv_px[:count, k], n, axis=0)
            for one in (blobs[n], told[n]):
                one.add(found[_apart(found, others)])
            live = [one for one in tracker.tracker.live if _apart(np.array([one.place_px]), others)[0]]
            best = colour.target(live)
            now.append((blobs[n].place_px, told[n].place_px, None if best is None else np.array(best.place_px)))
        places.append(now)
        if not hidden and k >= asked and all(tracker.held(one.name) is not None for one in codes):
            break
    outcomes = [_of_code(film, tracker, n, asked, cell) for n in range(count)]
    for number, way in enumerate(("blob", "told blob", "colour")):
        for n in range(count):
            own = [now[n][number] for now in places]
            said = [_on(film, n, k, place) for k, place in enumerate(own)]
            first = next((k for k, value in enumerate(said) if value), -1)
            outcomes.append(Outcome(way, *cell, n, first, said[asked] == 1, said[asked], said[-1]))
    return outcomes


def _apart(uv_px: Array, others_px: Array) -> NDArray[np.bool_]:
    distance = np.linalg.norm(uv_px[:, None] - others_px[None], axis=-1)
    return np.asarray(distance.min(axis=1, initial=np.inf) > _OTHERS_PX)


def _on(film: StagedFilm, target: int, frame: int, place: Array | None) -> int:
    """1 for a place on the target, -1 for one on something else, 0 for none."""
    if place is None:
        return 0
    return 1 if float(np.linalg.norm(film.uv_px[target, frame] - place)) < ON_IT_PX else -1


def _of_code(film: StagedFilm, tracker: TargetTracker, n: int, asked: int, cell: tuple[float, int, int]) -> Outcome:
    holds = [hold for hold in tracker.holds if hold.target == str(n)]

    def at(frame: int) -> int:
        for hold in holds:
            if hold.locked <= frame and (hold.lost < 0 or frame < hold.lost):
                return _on(film, n, frame, np.array(hold.track.uv_px[frame - hold.track.first]))
        return 0

    first = holds[0].locked if holds else -1
    again = holds[1].locked if len(holds) > 1 else -1
    losses = sum(hold.lost >= 0 for hold in holds)
    right = bool(holds) and all(at(hold.locked) == 1 for hold in holds)
    return Outcome("code", *cell, n, first, right, at(asked), at(tracker.frame), losses, again)


def swept(
    rooms: Sequence[RenderedRoom],
    stream: str,
    cell: tuple[float, int],
    films: Sequence[int],
    kept: Path,
    frames: int = 24,
    hidden: Hidden = MappingProxyType({}),
) -> list[Outcome]:
    """Outcomes of films of one signal and number of other lights; those in the file `kept` are not made again."""
    rows = [Outcome(**json.loads(line)) for line in kept.read_text().splitlines()] if kept.exists() else []
    for number in films:
        key = (*cell, number)
        if any((one.sigma, one.lights, one.film) == key for one in rows):
            continue
        names = (stream, number, f"{cell[0]:g}", cell[1])
        film = staged(rooms[number % len(rooms)], names, cell[0], cell[1], frames, targets=4)
        new = followed(film, key, hidden=hidden)
        rows += new
        with kept.open("a") as file:
            file.writelines(json.dumps(asdict(one)) + "\n" for one in new)
    return [one for one in rows if (one.sigma, one.lights) == cell and one.film in films]
