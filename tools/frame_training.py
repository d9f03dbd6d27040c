"""Training of `learned_detect`, the network for whole frames, by PyTorch; its peak thresholds and covariance scale.

    python -m tools.frame_training out/bench-dev --out learned_detect.onnx --seed 0

Packages and seeds are as in `tools/crop_training.py`. Hot cells come from tiles of crops, so from spots at all phases
and brightnesses; cold ones from whole frames, half of them where the network itself is wrong most. Cells about a
distractor that goes out with the laser count as neither: it is a spot, only a fainter one.

Rooms that are held out, and the others, give the thresholds of a peak; rooms that are held out give the scale of the
covariance, from spots that were found.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.input_files import MIB, InputFile
from phibench.datasets.exposures.pair_draws import CachedSample, PairDraw, pair_draws
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.read import Dataset, open_finished
from phibench.datasets.training import CropSettings, SpotCrops
from phibench.estimator.interface import Box
from phibench.estimator.learned.network_file import read_model
from phibench.estimator.learned.network_graphs import CROP, DETECT, DETECTOR, Weights
from phibench.estimator.learned.network_input import frame_input
from phibench.estimator.learned.networks import (
    Network,
    NetworkError,
    heat_peaks,
    refined_position,
    shipped_network,
    write_network,
)
from phibench.estimator.spots.detect import mirror_box, outline_mask
from phibench.estimator.spots.image_planes import kind_of
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import POSITIONS
from tools.crop_training import (
    REQUESTS,
    AdamSteps,
    Answers,
    Parameters,
    TrainingSettings,
    exit_code_of,
    first_layer,
    one_or_more,
    rooms_of,
    scale_of,
    torch_on_one_thread,
)

TILE_PX = 64
_SIDE = TILE_PX // 2  # cells
_HOT, _NEITHER = 1.5, 4.0  # cells about a spot that are to be hot, and that are not cold
_LEAST_Z = np.arcsinh(2.5 / 3.0)  # of a cell, as `frame_input` compresses it: a fainter spot is neither
_OF_SPOTS = 20.0  # weight of a hot cell: a tile has a hundred times as many cold ones
_OF_A_FRAME = 6  # tiles, in each round
_SPOTS = CropSettings(side_px=TILE_PX + 2, spread_px=20.0, laser_levels=(0.1, 2.0))
_FOUND = CropSettings(side_px=TILE_PX + 2, spread_px=14.0, laser_levels=(0.25, 1.0))  # levels of the recipe
_NEAR_PX = 3.0  # farther away it is false


@dataclass(frozen=True)
class FrameSettings:
    """Choices of a training run.

    Parameters
    ----------
    seed : int
        Of all streams; it holds out rooms as that of `TrainingSettings` does.
    spots : int
        Tiles with a spot.
    rounds, passes : int
        In each round tiles of frames are chosen anew; all tiles are used so many times.
    batch : int
    rate : float
        Largest step of Adam.
    checked : int
        Tiles of held-out rooms that give the covariance's scale.
    """

    seed: int = 0
    spots: int = 5000
    rounds: int = 3
    passes: int = 2
    batch: int = 32
    rate: float = 3e-3
    checked: int = 900


# -- tiles and frames ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tiles:
    """Inputs (n, 3, h, w), heat (n, h, w) that is 0 or 1, and cells that count (n, h, w)."""

    planes: NDArray[Any]
    heat: NDArray[np.float32]
    counted: NDArray[np.float32]


@dataclass(frozen=True)
class FrameMap:
    """The mirror's part of one frame.

    Attributes
    ----------
    preset : str
    planes : shape (3, h, w), float16
    red_e, heat, counted : shape (h, w)
        `counted` is 0 outside the outline and where cells are neither.
    """

    preset: str
    planes: NDArray[np.float16]
    red_e: Array
    heat: NDArray[Any]
    counted: NDArray[Any]


def targets(planes: NDArray[Any], spots: Sequence[Array], others: Sequence[Array]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Heat and counted cells, shape (h, w), for spots and other lights at pixels (u, v) of the part."""
    v, u = np.indices(planes.shape[1:])
    heat, counted = np.zeros(u.shape, np.float32), np.ones(u.shape, np.float32)
    for number, uv in enumerate((*others, *spots)):
        distance = np.hypot(2.0 * u + 0.5 - uv[0], 2.0 * v + 0.5 - uv[1]) / 2.0
        counted[distance < _NEITHER] = 0.0
        hot = distance < _HOT
        if number >= len(others) and hot.any() and planes[0][hot].max() >= _LEAST_Z:
            heat[hot] = counted[hot] = 1.0
    return heat, counted


def spot_crops(
    folder: Path, samples: Sequence[str], length: int, seed: int, settings: CropSettings = _SPOTS
) -> SpotCrops:
    """Crops that tiles are cut from."""
    options = TrainingSettings().options
    return SpotCrops([folder], options, length, seed=seed, settings=settings, samples=samples, laser_off=True)


def _cut(crops: SpotCrops) -> Iterator[tuple[Any, ...]]:
    """Pixels on and off of 64 x 64 that begin with red, card, the filters' response, and the spot's place in them."""
    for k in range(len(crops)):
        crop = crops.crop(k)
        u0, v0 = crop.phase_px % 2
        part = (slice(v0, v0 + TILE_PX), slice(u0, u0 + TILE_PX))
        assert crop.image_off is not None, "asked for"
        yield crop.image[part], crop.image_off[part], crop.card, crop.response, crop.uv_px - [u0, v0]


def spot_tiles(crops: SpotCrops) -> Tiles:
    """Tiles with a spot, at all phases."""
    tiles = []
    for on, off, card, _, uv in _cut(crops):
        planes, _ = frame_input(on, off, card)
        tiles.append((planes, *targets(planes, [uv], [])))
    return Tiles(*(np.stack(column) for column in zip(*tiles, strict=True)))


def frame_maps(folder: Path, samples: Sequence[str], turn: int = 0) -> list[FrameMap]:
    """Frames of samples: of each one in a quarter of the requests, which of them takes turns."""
    dataset = open_finished(folder)
    maps: list[FrameMap] = []
    draws = {one: {draw.sample_id: draw for draw in pair_draws(dataset, one, 1)} for one in REQUESTS}
    for number, name in enumerate(samples):
        cached = CachedSample.of(dataset[name])
        for preset, requests in REQUESTS.items():
            for overrides in requests[(number + turn) % 4 :: 4]:
                draw = draws[preset][name]
                draw = replace(draw, draw=turn, request=replace(draw.request, overrides=dict(overrides)))
                maps += _maps_of(cached, draw, dataset)
    return maps


def _maps_of(cached: CachedSample, draw: PairDraw, dataset: Dataset) -> Iterator[FrameMap]:
    source, box = cached.source(draw), mirror_box(cached.nominal_rig)
    box = Box(box.u0_px, box.v0_px, box.width_px // 2 * 2, box.height_px // 2 * 2)
    inside = outline_mask(cached.nominal_rig, box)[::2, ::2]
    card = card_of(source.sides["down"].chain.sensor)
    for position in POSITIONS:
        on, off = (source.frame(position, draw.draw, laser).image[box.slices] for laser in (True, False))
        planes, red = frame_input(on, off, card)
        truth = dataset[draw.sample_id].truth_row(position)
        followers = [one.truths[position] for one in cached.distractors if one.follows_laser]
        lights = ([truth.centre] if truth.visible else [], [one for one in followers if one.visible])
        places = [[np.array([one.u_px - box.u0_px, one.v_px - box.v0_px]) for one in part] for part in lights]
        heat, counted = targets(planes, *places)
        yield FrameMap(draw.preset, planes.astype(np.float16), red, heat, counted * inside.astype(np.float32))


def _cold_tiles(maps: Sequence[FrameMap], heats: Sequence[Array], draw: np.random.Generator) -> Tiles:
    """Tiles of frames, half of them about the hottest cells that are to be cold, half by chance."""
    tiles = []
    for one, heat in zip(maps, heats, strict=True):
        cold = (one.counted > 0.0) & (one.heat == 0.0)
        peaks = heat_peaks(heat, one.red_e, cold, -np.inf)
        hottest = peaks.cells[np.argsort(-peaks.heat, kind="stable")[: _OF_A_FRAME // 2], ::-1]
        anywhere = np.argwhere(cold)[draw.integers(cold.sum(), size=_OF_A_FRAME - len(hottest))]
        for at in np.concatenate([hottest, anywhere]).astype(int):
            shift = draw.integers(-_SIDE // 4, _SIDE // 4 + 1, 2)
            v, u = np.clip(at - _SIDE // 2 + shift, 0, np.array(cold.shape) - _SIDE)
            part = (slice(v, v + _SIDE), slice(u, u + _SIDE))
            tiles.append((one.planes[:, *part].astype(np.float32), one.heat[part], one.counted[part]))
    return Tiles(*(np.stack(column) for column in zip(*tiles, strict=True)))


# -- the network of frames -------------------------------------------------------------------------------------------


def first_detector_weights(seed: int) -> Weights:
    """Weights before training."""
    draw = generator("learned", "detector weights", seed)
    weights: Weights = {}
    for name, of, to in DETECTOR:
        weights |= first_layer(draw, name, (to, of, 3, 3))
    return weights | first_layer(draw, "heat", (1, DETECTOR[-1][2], 1, 1))


def detector_forward(torch: Any, p: Parameters, planes: Any) -> Any:
    """Heat of frames or tiles, shape (n, h, w): the logarithm of the odds of a spot."""
    x = planes
    for name, _, _ in DETECTOR:
        x = torch.nn.functional.relu(torch.nn.functional.conv2d(x, p[f"{name}.w"], p[f"{name}.b"], padding=1))
    return torch.nn.functional.conv2d(x, p["heat.w"], p["heat.b"])[:, 0]


def heats_of(p: Parameters, maps: Sequence[FrameMap]) -> list[Array]:
    """Heat of each frame, shape (h, w)."""
    torch = torch_on_one_thread()
    with torch.no_grad():
        return [
            detector_forward(torch, p, torch.from_numpy(one.planes[None].astype(np.float32))).numpy()[0].astype(float)
            for one in maps
        ]


def train_detector(spots: Tiles, maps: Sequence[FrameMap], settings: FrameSettings) -> Weights:
    """Weights of the network of frames, by a weighted cross entropy of cells."""
    torch, draw = torch_on_one_thread(), generator("learned", "detector", settings.seed)
    p = {name: torch.tensor(x, requires_grad=True) for name, x in first_detector_weights(settings.seed).items()}
    each_round = settings.passes * ((len(spots.planes) + _OF_A_FRAME * len(maps)) // settings.batch)
    steps = AdamSteps(torch, p, settings.rate, settings.rounds * each_round)
    for number in range(settings.rounds):
        # before the first round red light itself is what misleads
        heats = heats_of(p, maps) if number else [one.planes[0].astype(float) for one in maps]
        cold = _cold_tiles(maps, heats, draw)
        parts = [np.concatenate(pair) for pair in zip(vars(spots).values(), vars(cold).values(), strict=True)]
        losses = [
            steps.step(_loss(torch, p, *(torch.from_numpy(part[rows]) for part in parts)))
            for _ in range(settings.passes)
            for rows in np.array_split(draw.permutation(len(parts[0])), len(parts[0]) // settings.batch)
        ]
        print(f"round {number}: loss {np.mean(losses[-100:]):.4f}", file=sys.stderr, flush=True)
    return {name: value.detach().numpy().copy() for name, value in p.items()}


def _loss(torch: Any, p: Parameters, planes: Any, heat: Any, counted: Any) -> Any:
    weight = counted * (1.0 + (_OF_SPOTS - 1.0) * heat)
    logits = detector_forward(torch, p, planes)
    each = torch.nn.functional.binary_cross_entropy_with_logits(logits, heat, weight=weight, reduction="sum")
    return each / weight.sum()


# -- thresholds and scale --------------------------------------------------------------------------------------------

_FALSE_ALONE = 0.01  # false peaks in a frame
# of one of two peaks that must fit each other, or in a box: a curve's share of the mirror is 0.01, and so is a box's
_FALSE_EACH = 1.0
_MARGIN = 0.5  # above the level alone, which few frames decide


def thresholds_of(weights: Weights, maps: Sequence[FrameMap]) -> dict[str, tuple[float, float]]:
    """Least heat of a peak alone, and of each of a pair, by preset; both are above 0.

    Alone: a margin above the level that one in a hundred frames exceeds with what is no spot. Of a pair, and in a box:
    one false peak in a frame.
    """
    p = {name: torch_on_one_thread().from_numpy(value) for name, value in weights.items()}
    thresholds: dict[str, tuple[float, float]] = {}
    for preset in REQUESTS:
        chosen, peaks = [one for one in maps if one.preset == preset], []
        for one, heat in zip(chosen, heats_of(p, chosen), strict=True):
            cold = (one.counted > 0.0) & (one.heat == 0.0)
            peaks.append(heat_peaks(heat, one.red_e, cold, -20.0).heat)
        every = np.sort(np.concatenate(peaks))[::-1]
        alone, each = (max(float(every[int(share * len(chosen))]), 0.0) for share in (_FALSE_ALONE, _FALSE_EACH))
        thresholds[preset] = (alone + _MARGIN, each)
    return thresholds


def answers_at_found(detector: Path, crops: SpotCrops, thresholds: Mapping[str, tuple[float, float]]) -> Answers:
    """Answers of the shipped network of crops at the places where a detector found the spot, its own scale left out."""
    finder, crop, errors, covariances = Network(detector, DETECT), shipped_network(CROP), [], []
    for on, off, card, response, uv in _cut(crops):
        planes, red = frame_input(on, off, card)
        heat = np.asarray(finder.run(planes=planes[None])[0][0, 0], float)
        peaks = heat_peaks(heat, red, np.ones(heat.shape, bool), thresholds[kind_of(card)][0])
        if not len(peaks.heat):
            continue
        place = 2.0 * peaks.cells[np.argmax(peaks.red_e)] + 0.5
        spot = refined_position(crop, on, off, card, response, (float(place[0]), float(place[1])), 1.0)
        if spot.uv_px is None or np.hypot(*(error := np.array(spot.uv_px) - uv)) > _NEAR_PX:
            continue
        errors.append(error)
        covariances.append(spot.covariance_px2)
    return Answers(np.array(errors).reshape(-1, 2), np.array(covariances, float).reshape(-1, 2, 2))


# -- from the command line -------------------------------------------------------------------------------------------


def train(folder: Path, out: Path, settings: FrameSettings) -> Path:
    """Train `learned_detect` and write its file."""
    began = time.process_time()
    seen, held = rooms_of(folder, settings.seed)
    maps = frame_maps(folder, seen)
    spots = spot_tiles(spot_crops(folder, seen, settings.spots, settings.seed + 2_000_000))
    _say(f"tiles and frames: {(time.process_time() - began) / 60.0:.1f} CPU-min")
    weights = train_detector(spots, maps, settings)
    thresholds = thresholds_of(weights, maps + frame_maps(folder, held) + frame_maps(folder, held, 1))
    entries = {
        "thresholds": json.dumps(thresholds),
        "covariance_scale": 1.0,
        "settings": json.dumps(asdict(settings), sort_keys=True),
    }
    write_network(out, DETECT, weights, entries)
    _say(f"thresholds {thresholds}; {(time.process_time() - began) / 60.0:.1f} CPU-min")
    return rescaled(folder, out, out, settings)


def rescaled(folder: Path, detector: Path, out: Path, settings: FrameSettings) -> Path:
    """Write a detector with the covariance's scale for the network of crops that phibench ships now."""
    model = read_model(InputFile(detector, "train it: docs/learned.md", NetworkError, MIB).read())
    thresholds = json.loads(Network(detector, DETECT).metadata["thresholds"])
    checks = spot_crops(folder, rooms_of(folder, settings.seed)[1], settings.checked, settings.seed + 3_000_000, _FOUND)
    answers = answers_at_found(detector, checks, thresholds)
    scale = scale_of(answers)
    _say(f"found {len(answers.error_px)} of {settings.checked}, scale {scale:.3f}")
    kept = {key: value for key, value in model.metadata.items() if key not in ("name", "version", "sha256")}
    return write_network(out, DETECT, model.tensors, kept | {"covariance_scale": scale})


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Train the network from the command line."""
    parser = argparse.ArgumentParser("python -m tools.frame_training", description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="finished data set")
    parser.add_argument("--out", type=Path, required=True, help="file to write, .onnx")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--spots", type=int, default=FrameSettings.spots, help="tiles with a spot")
    told_passes = f"times that a round's tiles are used; {FrameSettings.passes} by default"
    parser.add_argument("--passes", type=one_or_more, default=FrameSettings.passes, help=told_passes)
    parser.add_argument("--rescale", type=Path, metavar="FILE", help="a detector that only gets a new covariance scale")
    given = parser.parse_args(arguments)
    settings = FrameSettings(given.seed, given.spots, passes=given.passes)
    if given.rescale is None:
        return exit_code_of(lambda: train(given.folder, given.out, settings))
    return exit_code_of(lambda: rescaled(given.folder, given.rescale, given.out, settings))


if __name__ == "__main__":
    sys.exit(main())
