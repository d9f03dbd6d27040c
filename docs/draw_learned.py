"""Networks of crops on rooms that they have not seen: by preset, outside the range of training, and a room leak test.

    .venv/bin/python -m docs.draw_learned measure DEV TEST NETWORKS out/learned.json
    .venv/bin/python -m docs.draw_learned seeds SCORES
    .venv/bin/python -m docs.draw_learned draw out/learned.json docs/learned.png
    .venv/bin/python -m docs.draw_learned pairs TEST SCORES NETWORKS
    .venv/bin/python -m docs.draw_learned found SCORES
    .venv/bin/python -m docs.draw_learned held DEV NETWORKS

SCORES is a folder with scores of `detect` and of others on TEST, such as mjpeg-detect.parquet, by `phibench score`.
`pairs` asks the networks at the places that `detect` answered; bounds and other methods' errors are the scores'.
`found` compares scores of `learned_detect` with those of `detect` and of the fits.
`held` is what a training is chosen by: crops of rooms of DEV that seed 0 does not train in, from faint to bright ones.

NETWORKS is a folder of ONNX files: released.onnx, and others to compare with it, such as other seeds and networks of
one preset. Crops count of which the first claims a deviation below a pixel.

`seeds` compares scores of detectors of other seeds with those of `learned_detect`: mjpeg-detect_seed1.parquet.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import polars as pl

from phibench.benchmark.scores.intervals import clopper_pearson
from phibench.datasets.exposures.pair_draws import CachedSample, PairDraw, pair_draws
from phibench.datasets.frames.request import FrameOptions
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.frames.source import frame_stream
from phibench.datasets.read import open_finished
from phibench.datasets.training import CropSettings, SpotCrops
from phibench.estimator.learned.network_input import SIDE_PX, crop_input, crop_origin, cut
from phibench.estimator.learned.networks import CROP, Network, covariances
from phibench.render.sensor.light import Region
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator
from tools.crop_training import CROP_SETTINGS, Answers, TrainingSettings, crops_of, rooms_of

LEAD = "released"
_LABELS = {
    LEAD: "released: 18 000 crops, 3 epochs",
    "seed1": "the same, seed 1",
    "short0": "3000 crops, 1 epoch",
    "bayer-raw": "the same of bayer-raw alone",
    "srgb8": "the same of srgb8 alone",
    "mjpeg": "the same of mjpeg alone",
}
COUNT, OUTSIDE_COUNT, LEAK_COUNT, RESAMPLES = 500, 250, 1200, 2000
SETTINGS = replace(CROP_SETTINGS, laser_levels=(0.25, 1.0))  # those of the recipe
SIZES: dict[str, dict[str, Any]] = {  # numbers of bench-test
    "bayer-raw": {"read_noise_e": 5.0},
    "srgb8": {"read_noise_e": 5.0},
    "mjpeg 50": {"jpeg_quality": 50, "read_noise_e": 5.0},
    "mjpeg 65": {"jpeg_quality": 65, "read_noise_e": 5.0},
    "mjpeg 80": {"jpeg_quality": 80, "read_noise_e": 5.0},
}
OUTSIDE = {  # what was trained: factors of 0.15 to 2, up to 2.5 px from the middle
    "brighter, 2 to 8 times": replace(SETTINGS, laser_levels=(2.0, 8.0)),
    "fainter, 0.05 to 0.15 times": replace(SETTINGS, laser_levels=(0.05, 0.15)),
    "up to 6 px from the middle": replace(SETTINGS, spread_px=6.0),
}


@dataclass(frozen=True)
class Crops:
    """Inputs of n crops with their true places, samples, and the blur of their cameras."""

    planes: Array
    scalars: Array
    uv_px: Array
    samples: Array
    blur_px: Array

    def answers(self, file: Path) -> Answers:
        """Answers of a network for all of them."""
        found = Network(file, CROP)
        uv, factor = found.run(planes=self.planes, scalars=self.scalars)
        scale = found.scale
        return Answers(uv.astype(float) - self.uv_px, covariances(factor.astype(float), scale))


def made(crops: SpotCrops, folder: Path) -> Crops:
    """Inputs of an epoch's crops, all with the laser-off image."""
    dataset, columns = open_finished(folder), []
    blur = {sample.row.sample_id: sample.rig.camera.blur_sigma_px for sample in dataset}
    for k in range(len(crops)):
        crop = crops.crop(k)
        u0, v0 = crop.phase_px % 2
        part = (slice(v0, v0 + SIDE_PX), slice(u0, u0 + SIDE_PX))
        assert crop.image_off is not None, "asked for"
        one = crop_input(crop.image[part], crop.image_off[part], crop.card)
        columns.append((one.planes, one.scalars, crop.uv_px - [u0, v0], crop.sample_id, blur[crop.sample_id]))
    return Crops(*(np.array(column) for column in zip(*columns, strict=True)))


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


def rms(errors_px: Array) -> float:
    """Root of the mean squared distance."""
    return float(np.sqrt((errors_px**2).sum(axis=1).mean())) if len(errors_px) else float("nan")


def table_of(crops: Crops, files: dict[str, Path], name: str, chosen: Array) -> dict[str, Any]:
    """Rms, median and pull of networks on the chosen crops."""
    rows = np.flatnonzero(chosen)
    found: dict[str, Any] = {"crops": len(rows), "rooms": len(set(crops.samples[rows]))}
    if not len(rows):
        return found
    for network, file in files.items():
        answers = crops.answers(file)
        error, pull, samples = answers.error_px[rows], answers.squared_pull[rows], crops.samples[rows]
        distance = np.linalg.norm(error, axis=1)
        found[network] = {
            "rms_px": interval(lambda k, e=error: rms(e[k]), samples, name),
            "median_px": interval(lambda k, d=distance: float(np.median(d[k])), samples, name),
            "pull": interval(lambda k, p=pull: float(np.sqrt(p[k].mean())), samples, name),
        }
    return found


def measure(dev: Path, test: Path, networks: Path, out: Path) -> None:
    """Write all numbers as JSON."""
    files = {file.stem: file for file in sorted(networks.glob("*.onnx"))}
    tables: dict[str, Any] = {}
    for size, numbers in SIZES.items():
        request = FrameOptions(size.split()[0], {"exposure": "auto", **numbers})
        crops = made(_crops(test, request), test)
        lead = crops.answers(files[LEAD])
        full = crops.planes[:, 3, 10:22, 10:22].any(axis=(1, 2))
        wide = crops.blur_px > 1.0
        for part, chosen in (
            ("", lead.sure),
            (", blur to 1.0 px", lead.sure & ~wide),
            (", blur above 1.0 px", lead.sure & wide),
            (", full pixels", lead.sure & full),
        ):
            tables[size + part] = table_of(crops, files, size + part, chosen)
            print(size + part, {k: v["rms_px"] if isinstance(v, dict) else v for k, v in tables[size + part].items()})
    for size in ("bayer-raw", "mjpeg 80"):
        request = FrameOptions(size.split()[0], {"exposure": "auto", **SIZES[size]})
        for part, settings in OUTSIDE.items():
            crops = made(_crops(test, request, settings, OUTSIDE_COUNT), test)
            name = f"{size}, {part}"
            tables[name] = table_of(crops, {LEAD: files[LEAD]}, name, crops.answers(files[LEAD]).sure)
            print(name, tables[name])
    tables["leak"] = leak(dev, files)
    print("leak", tables["leak"])
    out.write_text(json.dumps(tables, indent=1))


def held(dev: Path, networks: Path) -> None:
    """Print rms, median and pull of networks in the rooms that seed 0 holds out, and rms by the light of the spot."""
    files = {file.stem: file for file in sorted(networks.glob("*.onnx"))}
    samples = rooms_of(dev, 0)[1]
    for size, numbers in {**SIZES, "mjpeg 95": {"jpeg_quality": 95}}.items():
        request = FrameOptions(size.split()[0], {"exposure": "auto", **numbers})
        crops = made(
            SpotCrops([dev], [request], COUNT, seed=79, settings=SETTINGS, samples=samples, laser_off=True), dev
        )
        lead = crops.answers(files[LEAD])
        light = crops.scalars[:, 0]
        edges = np.quantile(light[lead.sure], [1 / 3, 2 / 3])
        for name, one in table_of(crops, files, size, lead.sure).items():
            if not isinstance(one, dict):
                continue
            error, third = crops.answers(files[name]).error_px, np.searchsorted(edges, light)
            thirds = [rms(error[lead.sure & (third == k)]) for k in range(3)]
            shown = {key: [round(x, 3) for x in value] for key, value in one.items()}
            print(size, name, shown, "thirds, faint ones first:", [round(x, 3) for x in thirds], flush=True)


def _crops(folder: Path, options: FrameOptions, settings: CropSettings = SETTINGS, count: int = COUNT) -> SpotCrops:
    return SpotCrops([folder], [options], count, seed=77, settings=settings, laser_off=True)


def leak(dev: Path, files: dict[str, Path]) -> dict[str, Any]:
    """Rms pull in rooms that were held out over that in rooms trained in, by network; and of all networks together.

    Networks count that have the settings of the released one; seeds, and so rooms, differ. Together, the same crops are
    answered by networks that were trained in their room and by others: the ratio of rms errors has no part of rooms.
    """
    numbers = {name: json.loads(Network(file, CROP).metadata["settings"]) for name, file in files.items()}
    numbers = {name: one for name, one in numbers.items() if {**one, "seed": 0} == {**numbers[LEAD], "seed": 0}}
    every = [row.sample_id for row in open_finished(dev).rows]
    held = {name: set(rooms_of(dev, one["seed"])[1]) for name, one in numbers.items()}
    crops = made(crops_of(dev, TrainingSettings(), every, LEAK_COUNT, 78), dev)
    answers = {name: crops.answers(files[name]) for name in numbers}
    found: dict[str, Any] = {}
    for name, one in answers.items():
        unseen = np.isin(crops.samples, sorted(held[name]))
        found[name] = ratio(one.squared_pull[one.sure], unseen[one.sure], crops.samples[one.sure])
    sure = np.all([one.sure for one in answers.values()], axis=0)
    outside, inside = np.full(len(sure), np.nan), np.full(len(sure), np.nan)
    for k, sample in enumerate(crops.samples):
        for part, chosen in ((outside, True), (inside, False)):
            some = [(answers[n].error_px[k] ** 2).sum() for n in numbers if (sample in held[n]) == chosen]
            part[k] = np.mean(some) if some else np.nan
    kept = np.flatnonzero(sure & np.isfinite(outside) & np.isfinite(inside))
    if len(kept):
        o, i = outside[kept], inside[kept]
        samples = crops.samples[kept]
        found["together"] = interval(lambda k: float(np.sqrt(o[k].mean() / i[k].mean())), samples, "leak")
        found["crops, rooms"] = [len(kept), len(set(samples))]
    return found


def ratio(squared: Array, unseen: Array, samples: Array) -> list[float]:
    """Root of the ratio of means in unseen and seen rooms, with the interval of rooms drawn again."""
    draw, means = generator("learned intervals", "rooms"), []
    for part in (unseen, ~unseen):
        rooms = sorted(set(samples[part]))
        sums = np.array([[squared[samples == room].sum(), (samples == room).sum()] for room in rooms])
        drawn = sums[draw.integers(len(rooms), size=(RESAMPLES, len(rooms)))].sum(axis=1)
        total = sums.sum(axis=0)
        means.append(np.concatenate([[total[0] / total[1]], drawn[:, 0] / drawn[:, 1]]))
    values = np.sqrt(means[0] / means[1])
    return [float(values[0]), *(float(x) for x in np.quantile(values[1:], [0.025, 0.975]))]


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
        _print(preset, other, others, others, (pull**2).mean(axis=1), bound, samples)
        for name, one in answers.items():
            _print(preset, name, (one.error_px**2).sum(axis=1), others, one.squared_pull, bound, samples)


def _print(preset: str, name: str, square: Array, others: Array, squared: Array, bound: Array, samples: Array) -> None:
    values: dict[str, Callable[[Array], float]] = {
        "rms": lambda k: float(np.sqrt(square[k].mean())),
        "median": lambda k: float(np.median(np.sqrt(square[k]))),
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
    dataset, kept, every = open_finished(test), None, {name: ([], []) for name in networks}
    draws = pair_draws(dataset, preset)
    for row in rows:
        if kept is None or kept.row.sample_id != row["sample_id"]:
            kept = CachedSample(dataset[row["sample_id"]])
        on, off, card, first = _part(kept, draws[row["number"]], row["image"], (row["u_px"], row["v_px"]))
        for name, network in networks.items():
            place = np.array([row["u_px"], row["v_px"]]) - first
            for _ in range(2):  # once more about the answer
                origin = crop_origin((float(place[0]), float(place[1])))
                answer = network.position(crop_input(cut(on, origin), cut(off, origin), card))
                place = answer.uv_px + origin
            every[name][0].append(place + first - [row["u_true_px"], row["v_true_px"]])
            every[name][1].append(answer.covariance_px2)
    return {name: Answers(np.array(error), np.array(covariance)) for name, (error, covariance) in every.items()}


def _part(sample: CachedSample, pair_draw: PairDraw, position: str, uv_px: tuple[float, float]) -> tuple[Any, ...]:
    """Pixels about a place with the laser on and off, the sensor's card, and their first column and row."""
    source = sample.source(pair_draw)
    side = source.sides[position]
    height, width = side.light.size
    u0, v0 = (
        int(min(max(2 * round(x / 2) - _PART_PX // 2, 0), size - _PART_PX))
        for x, size in zip(uv_px, (width, height), strict=True)
    )
    region = Region(u0, v0, u0 + _PART_PX, v0 + _PART_PX)
    images = [
        side.chain.frame(light, frame_stream(*source.names, position, laser, pair_draw.noise_draw), region)
        for light, laser in ((side.light, True), (side.light.laser_off(), False))
    ]
    return (*images, card_of(side.chain.sensor), np.array([u0, v0]))


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


def seeds(scores: Path) -> None:
    """Print what detectors of other seeds find and answer falsely, and the difference to the released one."""
    for preset in OTHERS:
        released = pl.read_parquet(scores / f"{preset}-learned_detect.parquet")
        _print_rates(preset, "learned_detect", released)
        for file in sorted(scores.glob(f"{preset}-detect_seed*.parquet")):
            name, table = file.stem.removeprefix(f"{preset}-"), pl.read_parquet(file)
            _print_rates(preset, name, table)
            _print_minus(preset, f"{name} minus learned_detect", table, released)


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


def draw(source: Path, out: Path) -> None:
    """Median and rms error by test preset, one colour for each network."""
    tables = json.loads(source.read_text())
    sizes = [size for size in SIZES if size in tables]
    figure, panels = plt.subplots(1, 2, figsize=(8.0, 3.2), layout="constrained", sharey=True)
    names = [name for name, one in tables["bayer-raw"].items() if isinstance(one, dict)]
    names.sort(key=lambda name: name != LEAD)
    for axes, key, title in zip(panels, ("median_px", "rms_px"), ("median", "rms"), strict=True):
        for shift, name in enumerate(names):
            found = np.array([tables[size][name][key] for size in sizes])
            x = np.arange(len(sizes)) + 0.12 * (shift - (len(names) - 1) / 2.0)
            bars = np.abs(found[:, 1:].T - found[:, 0])
            axes.errorbar(x, found[:, 0], bars, fmt="o", markersize=4, capsize=2, label=_LABELS.get(name, name))
        axes.set_xticks(np.arange(len(sizes)), [size.replace(" ", "\n") for size in sizes])
        axes.set(yscale="log", title=f"{title} distance, px")
        axes.grid(axis="y", which="both", alpha=0.3)
    panels[0].legend(fontsize=8)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    if sys.argv[1] == "measure":
        measure(*map(Path, sys.argv[2:6]))
    elif sys.argv[1] == "seeds":
        seeds(Path(sys.argv[2]))
    elif sys.argv[1] == "pairs":
        pairs(*map(Path, sys.argv[2:5]))
    elif sys.argv[1] == "found":
        found(Path(sys.argv[2]))
    elif sys.argv[1] == "held":
        held(*map(Path, sys.argv[2:4]))
    else:
        draw(*map(Path, sys.argv[2:4]))
