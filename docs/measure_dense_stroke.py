"""Two frames against a whole stroke: `dense_sweep` and `dense_stroke` in the rooms of a data set, or of films.

Usage: python docs/measure_dense_stroke.py DATASET FRAMES [EVERY] [WIDTH]
       python docs/measure_dense_stroke.py FILMS,FILMS,... - [EVERY] [WIDTH]

Of a data set every third sample, or every EVERYth, gets three more MJPEG frames at a quarter, a half and three quarters
of its stroke: laser off, by the sample's own rig, room, light map, sensor and exposure. They are rendered into the
folder FRAMES, where a further run finds them. Other lights (`[[distractors]]`) are left out of them. WIDTH is that of
the panoramas, 960 by default.

Of films, such as those of docs/films_of_strokes.toml, frames between are the camera's own while the carriage moves.
Beside them are stills in the same poses, with their true heights: the same key views of the room, and another noise.
The light of each room is made such that auto exposure would choose the film's: films have no auto exposure.
With "one height", rows of a frame are taken to be exposed at one height, as if there were no rolling shutter.

Prints a row per sample or film, then medians and gains with intervals over samples.
"""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
from PIL import Image

from phibench.benchmark.dense.dense_films import MOST_BETWEEN, DenseFilms
from phibench.benchmark.dense.dense_pairs import with_between
from phibench.datasets.build.bake_task import bake_settings, read_light_map
from phibench.datasets.film.film_read import Film, film_light
from phibench.datasets.frames.frame_source import noise_draw
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.read import Dataset, Sample, open_dataset
from phibench.datasets.store.files import write_bytes
from phibench.datasets.store.schema import TruthFolder
from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair
from phibench.estimator.dense.sweep import dense_stroke, dense_sweep
from phibench.estimator.dense.unrolled_pair import WIDTH_PX
from phibench.render.optics.correspondence import Correspondence
from phibench.render.sensor.camera_chain import Chain, auto_exposed
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.processing import jpeg_image
from phibench.scenes.frames import Array

PARTS = (0.25, 0.5, 0.75)
FILMS = {"three between": PARTS}
RECALLED = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)


def film(sample: Sample, folder: Path, number: int) -> dict[float, Array]:
    """Frames between, by part of the stroke; rendered where they are not there."""
    files = {part: folder / f"{sample.row.sample_id}-{part}.jpg" for part in PARTS}
    for part, file in files.items():
        if not file.is_file():
            write_bytes(file, rendered(sample, part, number))
    return {part: np.asarray(Image.open(io.BytesIO(file.read_bytes())).convert("RGB")) for part, file in files.items()}


def rendered(sample: Sample, part: float, number: int) -> bytes:
    """JPEG file of the camera at a part of the stroke."""
    from phibench.render.room.ambient_layer import render_ambient
    from phibench.render.room.noise_budget import BUDGETS
    from phibench.render.sensor.electrons import frame_stream
    from phibench.render.sensor.light import Light
    from phibench.render.setup.variant import activate

    activate()
    ambient, source = sample.dataset.recipe.ambient, sample.frame_source("mjpeg")
    light_map, side = read_light_map(sample.dataset.folder, sample.row.room), source.sides["down"]
    layer = render_ambient(
        sample.rig.at(part * sample.row.stroke_m),
        sample.room,
        light_map,
        bake_settings(ambient),
        ambient.cells_per_pixel,
        1000 + number,
        budget=BUDGETS[ambient.quality],
    )
    planes = np.asarray(layer.electrons_per_s, np.float32)
    light = Light(planes, lamp_level=side.light.lamp_level, laser_level=0.0, f_number=side.light.f_number)
    return side.chain.jpeg_bytes(light, frame_stream(*source.names, f"step {part}", False, noise_draw("mjpeg", 0)))


def with_parts(pair: DensePair, frames: dict[float, Array], parts: tuple[float, ...]) -> DensePair:
    """The pair with frames between."""
    return with_between(pair, [frames[part] for part in parts], tuple(part * pair.stroke_m for part in parts))


def pair_of(sample: Sample) -> DensePair:
    """Dense pair of a sample, as `dense_pairs` makes it."""
    source = sample.frame_source("mjpeg")
    down, up = (source.frame(position, laser=False).image for position in ("down", "up"))
    card = card_of(source.sides["down"].chain.sensor)
    return DensePair(0, down, up, sample.nominal_rig, sample.row.nominal_stroke_m, card)


def relative(answer: DenseAnswer, found: Correspondence) -> Array:
    """Relative errors, NaN where there is no answer or the point is not in both images."""
    assert answer.depth_m is not None
    return np.where(found.seen, answer.depth_m / found.depth_m - 1.0, np.nan)


def numbers(error: Array, pixels: int) -> dict[str, float]:
    """Metrics of one answer, per cent."""
    size = np.abs(error[np.isfinite(error)])
    found = {"answered": len(size) / pixels, "median": np.median(size), "above 10 %": np.mean(size > 0.1)}
    found["recall"] = np.mean([np.count_nonzero(size <= limit) for limit in RECALLED]) / pixels
    return {name: 100.0 * float(value) for name, value in found.items()}


def claims(answer: DenseAnswer) -> Array:
    """Relative sigma."""
    assert answer.depth_m is not None
    assert answer.sigma_depth_m is not None
    return answer.sigma_depth_m / answer.depth_m


def surest(error: Array, claim: Array, count: int) -> float:
    """Median size of the so many errors with the least claims."""
    known = np.flatnonzero(np.isfinite(error))
    order = np.argsort(claim.reshape(-1)[known], kind="stable")[:count]
    return float(np.median(np.abs(error.reshape(-1)[known[order]])))


def told(name: str, values: list[float]) -> str:
    """Median and mean with intervals over samples."""
    draws = np.random.default_rng(1).choice(values, (4000, len(values)))
    parts = []
    for word, of in (("median", np.median), ("mean", np.mean)):
        low, high = np.percentile(of(draws, axis=1), [2.5, 97.5])
        parts.append(f"{word} {of(values):.3f} ({low:.3f} to {high:.3f})")
    return f"{name}: {', '.join(parts)}, of {len(values)}"


Asked = dict[str, DensePair]
"""Pairs of one stroke: "two", with two frames, and by another name those with images between."""


def asked_of_samples(dataset: Dataset, folder: Path, every: int) -> Iterator[tuple[str, Asked, Correspondence]]:
    """Name, pairs and truth of each sample."""
    for number in range(0, len(dataset), every):
        sample = dataset[number]
        pair, frames = pair_of(sample), film(sample, folder, number)
        asked = {"two": pair, **{name: with_parts(pair, frames, parts) for name, parts in FILMS.items()}}
        yield sample.row.sample_id, asked, sample.correspondence()


def asked_of_films(films: DenseFilms, every: int) -> Iterator[tuple[str, Asked, Correspondence]]:
    """Name, pairs and truth of each stroke."""
    for number in range(0, len(films), every):
        lit_as_exposed(films.stroke(number)[0])
        pair = films.pair(number)
        two = replace(pair, between=None, between_m=(), between_row_m=())
        asked = {"two": two, "film": pair, "stills": with_stills(films, two)}
        asked["one height"] = replace(pair, between_row_m=())
        yield films.stroke(number)[1].film_id, asked, films.truth(number).found


def lit_as_exposed(film: Film) -> None:
    """Give the room the light for which auto exposure chooses the film's exposure, as frames of a data set have it."""
    camera, light = film.sensor("mjpeg"), film.light(0).laser_off()
    chosen = auto_exposed(camera, light)
    film.views[:] *= chosen.exposure_s * chosen.analogue_gain / camera.exposure_s


def with_stills(films: DenseFilms, pair: DensePair) -> DensePair:
    """A pair of two frames with stills in the poses of its film's frames between, at their true heights."""
    film, stroke, draw = films.stroke(pair.number)
    scene = film.plan.scene
    # rows of a still are all exposed at the time of the frame, on 0.1 mm of the way at most
    still = replace(scene, times=replace(scene.times, exposure_s=1e-4, readout_s=0.0))
    at_once = replace(film, plan=replace(film.plan, scene=still))
    vars(at_once)["views"] = film.views
    camera = Chain(film.sensor("mjpeg"), pair.number, scene.rig.camera)
    images = []
    for frame in stroke.between:
        light = film_light(scene, at_once.room(frame), film.spots[frame]).laser_off()
        images.append(jpeg_image(camera.jpeg_bytes(light, NoiseStream((*film.plan.names, "still", frame, draw)))))
    heights = scene.offset_m(scene.times.frame_s[list(stroke.between)])
    return with_between(pair, images, tuple(map(float, heights)))


def compared(asked: Asked, truth: Correspondence, width_px: int) -> dict[str, float]:
    """Metrics of all pairs of a stroke, and each against those with two frames; a film also against its like."""
    found, claimed, row = {}, {}, {}
    for name, one in asked.items():
        begin = time.process_time()
        answer = (dense_stroke if one.between_m else dense_sweep)(one, width_px)
        seconds = time.process_time() - begin
        found[name], claimed[name] = relative(answer, truth), claims(answer)
        own = {**numbers(found[name], int(truth.seen.sum())), "CPU s": seconds}
        row |= {f"{name}: {key}": value for key, value in own.items()}
    others = [(name, "two") for name in asked if name != "two"]
    for name, other in [*others, *(("film", like) for like in ("stills", "one height") if like in asked)]:
        both = np.isfinite(found[other]) & np.isfinite(found[name])
        ratio = np.median(np.abs(found[name][both])) / np.median(np.abs(found[other][both]))
        row[f"{name} over {other}, median at the same pixels"] = float(ratio)
        count = min(int(np.isfinite(found[one]).sum()) for one in (other, name))
        same = surest(found[name], claimed[name], count) / surest(found[other], claimed[other], count)
        row[f"{name} over {other}, median at the same share"] = same
        for key in ("recall", "answered", "above 10 %"):
            row[f"{name} less {other}, {key}, points"] = row[f"{name}: {key}"] - row[f"{other}: {key}"]
    return row


def main() -> None:
    """Print the figures."""
    sources, folder = [Path(name) for name in sys.argv[1].split(",")], Path(sys.argv[2])
    every = int(sys.argv[3]) if len(sys.argv) > 3 else 3
    width_px = int(sys.argv[4]) if len(sys.argv) > 4 else WIDTH_PX
    if (sources[0] / TruthFolder.FILMS.value).is_file():
        films = (DenseFilms(source, between=MOST_BETWEEN) for source in sources)
        strokes = chain.from_iterable(asked_of_films(some, every) for some in films)
    else:
        strokes = chain.from_iterable([asked_of_samples(open_dataset(sources[0]), folder, every)])
    rows = []
    for label, asked, truth in strokes:
        rows.append(compared(asked, truth, width_px))
        shown = "; ".join(f"{key} {value:.3g}" for key, value in rows[-1].items() if "CPU" not in key)
        heights = max(len(one.between_m) for one in asked.values())
        print(f"{label}, h = {asked['two'].stroke_m:.2f} m, {heights} between: {shown}", flush=True)
    for name in rows[0]:
        print(told(name, [row[name] for row in rows]))


if __name__ == "__main__":
    main()
