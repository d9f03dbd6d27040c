"""Networks on pairs of a test set whose rooms they have not seen: by light, against a fit, and what detectors find.

    .venv/bin/python -m docs.draw_learned pairs TEST SCORES NETWORKS
    .venv/bin/python -m docs.draw_learned boxes TEST SCORES
    .venv/bin/python -m docs.draw_learned found SCORES
    .venv/bin/python -m docs.draw_learned shapes TEST

`boxes` reads the track `localise` of `phibench bench`, and compares with what on - off can tell of each spot. SCORES is
a folder with scores of `detect` and of others on TEST, such as mjpeg-detect.parquet, by `phibench score`.
NETWORKS is a folder of ONNX files of networks of crops. `pairs` asks them at the places that `detect` answered; bounds
and the fit's errors are the scores'. `found` compares scores of `learned_detect` with those of `detect` and the fits.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from phibench.benchmark.pair_sets.dataset_pairs import dataset_pairs
from phibench.benchmark.scores.intervals import clopper_pearson
from phibench.datasets.exposures.pair_draws import CachedSample, FrameCounts, PairDraw, pair_draws
from phibench.datasets.frames.frame_source import frame_stream, noise_draw
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.read import open_finished
from phibench.estimator.learned.network_graphs import CROP
from phibench.estimator.learned.network_input import crop_input, crop_origin, cut_part
from phibench.estimator.learned.networks import Network
from phibench.render.sensor.light import Region
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import POSITIONS
from tools.crop_training import Answers

RESAMPLES = 2000
LIGHT_E = ((1e3, 3e4), (1e3, 3e3), (3e3, 1e4), (1e4, 3e4), (3e4, np.inf), (0.0, np.inf))
"""Ranges of the spot's light, electrons."""
LEAST_CASES = 30


def interval(values: Callable[[Array], float], samples: Array, name: str) -> list[float]:
    """Value of all crops, and its 95 % interval by drawing samples, which are rooms, again."""
    draw, rooms = generator("learned intervals", name), sorted(set(samples))
    members = [np.flatnonzero(samples == room) for room in rooms]
    drawn = [
        values(np.concatenate([members[k] for k in draw.integers(len(rooms), size=len(rooms))]))
        for _ in range(RESAMPLES)
    ]
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    return [values(np.arange(len(samples))), float(low), float(high)]


OTHERS = {"bayer-raw": "raw_maximum_likelihood", "srgb8": "chain_fit", "mjpeg": "chain_fit"}
_PART_PX = 64  # of a frame that is simulated about a place


def pairs(test: Path, scores: Path, networks: Path) -> None:
    """Print rms, median, efficiency and pull of networks on detected spots, and of another method on the same ones."""
    read = {file.stem: Network(file, CROP) for file in sorted(networks.glob("*.onnx"))}
    for preset, other in OTHERS.items():
        keys = ["number", "image"]
        records = pl.read_parquet(scores / f"{preset}-detect.parquet").filter(
            "detected", (pl.col("bound_px2") < 1.0).fill_null(False)
        )
        theirs = pl.read_parquet(scores / f"{preset}-{other}.parquet").filter("detected")
        both = records.join(theirs.select(*keys, "du_px", "dv_px", "pull_u", "pull_v"), on=keys, suffix="_other")
        rows = both.sort("sample_id").to_dicts()
        answers = _asked(test, preset, rows, read)
        samples, bound = np.array([row["sample_id"] for row in rows]), np.array([row["bound_px2"] for row in rows])
        error = np.array([[row["du_px_other"], row["dv_px_other"]] for row in rows], float)
        pull = np.array([[row["pull_u_other"], row["pull_v_other"]] for row in rows], float)
        others = (error**2).sum(axis=1)
        light = np.array([row["electrons"] for row in rows])
        for low, high in LIGHT_E:
            k = np.flatnonzero((light >= low) & (light < high))
            name = f"{preset} {low:.0f} to {high:.0f} e-:"
            if len(k) < LEAST_CASES:
                print(name, f"{len(k)} spots: too few")
                continue
            _print(name, other, others[k], others[k], (pull[k] ** 2).mean(axis=1), bound[k], samples[k])
            for key, one in answers.items():
                square, squared = (one.error_px[k] ** 2).sum(axis=1), one.squared_pull[k]
                _print(name, key, square, others[k], squared, bound[k], samples[k])


def boxes(test: Path, scores: Path) -> None:
    """Print the same in boxes, of spots that all three find: a fit, `learned_crop` and `joint_fit`.

    Beside them stands the efficiency of a perfect method that knows the room from its laser-off frame alone.
    """
    keys = ["number", "image"]
    for preset, other in OTHERS.items():
        tables = {
            name: pl.read_parquet(scores / f"{preset}-{name}-localise.parquet").filter("detected")
            for name in (other, "learned_crop", "joint_fit")
        }
        common = tables[other].filter((pl.col("bound_px2") < 1.0).fill_null(False)).select(keys)
        common = common.join(_room_bounds(test, preset), on=keys)
        for table in tables.values():
            common = common.join(table.select(keys), on=keys)
        for low, high in (LIGHT_E[0], LIGHT_E[4]):
            told = f"{preset} {low:.0f} to {high:.0f} e-:"
            chosen = {name: _of_light(table.join(common, on=keys), low, high) for name, table in tables.items()}
            others = (chosen[other]["du_px"] ** 2 + chosen[other]["dv_px"] ** 2).to_numpy()
            bound, room, samples = (chosen[other][key].to_numpy() for key in ("bound_px2", "room_px2", "sample_id"))
            for name, rows in chosen.items():
                square = (rows["du_px"] ** 2 + rows["dv_px"] ** 2).to_numpy()
                pull = ((rows["pull_u"] ** 2 + rows["pull_v"] ** 2) / 2.0).to_numpy()
                _print(told, name, square, others, pull, bound, samples)
            perfect = interval(lambda k, b=bound, r=room: float(np.sqrt(b[k].mean() / r[k].mean())), samples, told)
            print(told, "perfect by on - off: efficiency", [round(x, 3) for x in perfect])


def _of_light(table: pl.DataFrame, low: float, high: float) -> pl.DataFrame:
    """Rows of spots with so many electrons, in one order for all methods."""
    return table.filter((pl.col("electrons") >= low) & (pl.col("electrons") < high)).sort(
        "sample_id", "number", "image"
    )


def _room_bounds(test: Path, preset: str) -> pl.DataFrame:
    """Bounds of spots whose room is known from one laser-off frame alone, px^2: number, image, room_px2."""
    pairs = dataset_pairs(open_finished(test), preset, frames=FrameCounts(1, 1))
    rows = []
    for number in range(len(pairs)):
        truth = pairs.truth(number)
        for image in POSITIONS:
            bound = getattr(truth, image).bound_px2
            rows.append((number, image, None if bound is None else float(np.trace(bound))))
    return pl.DataFrame(rows, schema=["number", "image", "room_px2"], orient="row")


def _print(preset: str, name: str, square: Array, others: Array, squared: Array, bound: Array, samples: Array) -> None:
    values: dict[str, Callable[[Array], float]] = {
        "rms": lambda k: float(np.sqrt(square[k].mean())),
        "median": lambda k: float(np.median(np.sqrt(square[k]))),
        "error over bound, geometric mean": lambda k: float(np.exp(0.5 * np.log(square[k] / bound[k]).mean())),
        "efficiency": lambda k: float(np.sqrt(bound[k].mean() / square[k].mean())),
        "pull": lambda k: float(np.sqrt(np.nanmean(squared[k]))),
        "rms over the other's": lambda k: float(np.sqrt(square[k].mean() / others[k].mean())),
        "90 % quantile over the other's": lambda k: float(
            np.sqrt(np.quantile(square[k], 0.9) / np.quantile(others[k], 0.9))
        ),
    }
    shown = {key: [round(x, 3) for x in interval(value, samples, preset + key)] for key, value in values.items()}
    print(preset, name, len(samples), shown)


def _asked(test: Path, preset: str, rows: list[dict[str, Any]], networks: dict[str, Network]) -> dict[str, Answers]:
    """Answers of networks for the spots of records."""
    every: dict[str, tuple[list[Array], list[Array]]] = {name: ([], []) for name in networks}
    for row, (on, off, card, response, first) in zip(rows, _parts(test, preset, rows), strict=True):
        for name, network in networks.items():
            place = np.array([row["u_px"], row["v_px"]]) - first
            for _ in range(2):  # once more about the answer
                origin = crop_origin((float(place[0]), float(place[1])))
                answer = network.position(crop_input(cut_part(on, origin), cut_part(off, origin), card, response))
                place = answer.uv_px + origin
            every[name][0].append(place + first - [row["u_true_px"], row["v_true_px"]])
            every[name][1].append(answer.covariance_px2)
    return {name: Answers(np.array(error), np.array(covariance)) for name, (error, covariance) in every.items()}


def _parts(test: Path, preset: str, rows: list[dict[str, Any]]) -> Iterator[tuple[Any, ...]]:
    """Pixels about the places of records, as `_part` gives them; records of one sample follow each other."""
    dataset, kept = open_finished(test), None
    draws = pair_draws(dataset, preset)
    for row in rows:
        if kept is None or kept.row.sample_id != row["sample_id"]:
            kept = CachedSample.of(dataset[row["sample_id"]])
        yield _part(kept, draws[row["number"]], row["image"], (row["u_px"], row["v_px"]))


def _part(sample: CachedSample, pair_draw: PairDraw, position: str, uv_px: tuple[float, float]) -> tuple[Any, ...]:
    """Pixels about a place, laser on and off, the sensor's card, the filters' response, first column and row."""
    source = sample.source(pair_draw)
    side = source.sides[position]
    height, width = side.light.size
    u0, v0 = (
        int(min(max(2 * round(x / 2) - _PART_PX // 2, 0), size - _PART_PX))
        for x, size in zip(uv_px, (width, height), strict=True)
    )
    region = Region(u0, v0, u0 + _PART_PX, v0 + _PART_PX)
    images = [
        side.chain.frame(
            light, frame_stream(*source.names, position, laser, noise_draw(pair_draw.preset, pair_draw.draw)), region
        )
        for light, laser in ((side.light, True), (side.light.laser_off(), False))
    ]
    response = sample.nominal_rig.camera.detector.laser_filter_response
    return (*images, card_of(side.chain.sensor), response, np.array([u0, v0]))


def shapes(test: Path) -> None:
    """Print which part of spots' light lies off a Gaussian of the same mean and covariance: half, 95 %, the most."""
    parts = []
    for sample in open_finished(test):
        for position in POSITIONS:
            light = sample.spot(position).electrons_per_s[0]
            if light.size and light.sum() > 0.0:
                parts.append(_off_gaussian(light / light.sum()))
    print(f"{len(parts)} spots:", np.round(np.quantile(parts, [0.5, 0.95, 1.0]), 5).tolist())


def _off_gaussian(light: Array) -> float:
    """Half the absolute difference of an image of sum 1, shape (h, w), and the Gaussian of its moments."""
    place = np.indices(light.shape).reshape(2, -1)
    offset = place - (place @ light.ravel())[:, None]
    covariance = (offset * light.ravel()) @ offset.T
    gaussian = np.exp(-0.5 * np.einsum("in,ij,jn->n", offset, np.linalg.inv(covariance), offset))
    return float(0.5 * np.abs(light.ravel() - gaussian / gaussian.sum()).sum())


def found(scores: Path) -> None:
    """Print hidden and visible spots that `detect` and `learned_detect` answer, and errors of the ones both find."""
    keys = ["number", "image"]
    for preset, other in OTHERS.items():
        tables = {m: pl.read_parquet(scores / f"{preset}-{m}.parquet") for m in ("detect", "learned_detect", other)}
        for name, table in tables.items():
            _print_rates(preset, name, table)
        _print_minus(preset, "learned_detect minus detect", tables["learned_detect"], tables["detect"])
        mine = tables["learned_detect"].filter("detected", (pl.col("bound_px2") < 1.0).fill_null(False))
        columns = ("du_px", "dv_px", "pull_u", "pull_v")
        both = mine.join(tables[other].filter("detected").select(*keys, *columns), on=keys, suffix="_other")
        rows = both.sort("sample_id")
        samples, bound = rows["sample_id"].to_numpy(), rows["bound_px2"].to_numpy()
        square, others = ((rows[f"du_px{e}"] ** 2 + rows[f"dv_px{e}"] ** 2).to_numpy() for e in ("", "_other"))
        pulls = [(rows[f"pull_u{e}"] ** 2 + rows[f"pull_v{e}"] ** 2).to_numpy() / 2.0 for e in ("", "_other")]
        _print(preset, "learned_detect", square, others, pulls[0], bound, samples)
        _print(preset, other, others, others, pulls[1], bound, samples)


def _print_rates(preset: str, name: str, table: pl.DataFrame) -> None:
    """Print hidden spots answered, and the rates of visible ones found and of images with a false answer."""
    hidden = table.filter(~pl.col("visible"))
    answered = hidden["u_px"].is_not_null().sum()
    low, high = clopper_pearson(answered, len(hidden), 0.95)
    samples = table["sample_id"].to_numpy()
    parts = {}
    for part, of in (("detected", "visible"), ("false_detection", None)):
        base = np.ones(len(table)) if of is None else table[of].to_numpy().astype(float)
        hits = table[part].to_numpy().astype(float) * (base if of else 1.0)
        parts[part] = interval(lambda k, h=hits, b=base: float(h[k].sum() / b[k].sum()), samples, preset + part)
    shown = {key: [round(x, 3) for x in value] for key, value in parts.items()}
    print(preset, name, f"hidden {answered} of {len(hidden)} [{low:.3f}, {high:.3f}]", shown)


def _print_minus(preset: str, name: str, first: pl.DataFrame, second: pl.DataFrame) -> None:
    """Print what one method finds and answers falsely more often than another one on the same images."""
    keys = ["number", "image"]
    one, two = first.sort(keys), second.sort(keys)
    seen, samples = one["visible"].to_numpy(), one["sample_id"].to_numpy()
    more, false = (one[c].to_numpy().astype(float) - two[c].to_numpy() for c in ("detected", "false_detection"))
    shown = [
        interval(lambda k: float(more[k].sum() / seen[k].sum()), samples, preset + "found"),
        interval(lambda k: float(false[k].mean()), samples, preset + "false"),
    ]
    print(preset, f"{name}: found, false", [[round(x, 3) for x in part] for part in shown])


if __name__ == "__main__":
    if sys.argv[1] == "pairs":
        pairs(*map(Path, sys.argv[2:5]))
    elif sys.argv[1] == "boxes":
        boxes(*map(Path, sys.argv[2:4]))
    elif sys.argv[1] == "shapes":
        shapes(Path(sys.argv[2]))
    else:
        found(Path(sys.argv[2]))
