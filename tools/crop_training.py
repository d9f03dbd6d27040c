"""Training of `learned_crop`, the network for crops around spots, by PyTorch; its covariance scale; shared helpers.

    python -m tools.crop_training out/bench-dev --out learned_crop.onnx --seed 0
    python -m tools.crop_training out/bench-dev --out my_crop.onnx --crops 8000 --passes 8   # a first try

Needs `pip install 'phibench[learned-training]'`; the CPU wheel is enough. Every random number comes from a named
stream: first weights, crops, their order and flips, and which rooms are held out. One thread: the same file each time.

Loss: -ln of a Gaussian, q / 2 - ln a - ln c with q = |L^T e|^2, L = ((a, 0), (b, c)) the Cholesky factor of the
precision and e the error (D. A. Nix, A. S. Weigend, "Estimating the mean and variance of the target probability
distribution", ICNN 1994). Errors beyond four claimed deviations count by their distance, not its square (P. J. Huber,
"Robust estimation of a location parameter", 1964): outliers are not to lead. Place: sum of w (cell + offset), w a
softmax over cells of 2 x 2 pixels, so that a shift of the image by a cell of the mosaic shifts the answer by as much.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import MIB, InputFile
from phibench.datasets.frames.frame_request import FrameOptions
from phibench.datasets.read import open_finished
from phibench.datasets.training import Crop, CropSettings, SpotCrops
from phibench.estimator.learned.network_file import read_model
from phibench.estimator.learned.network_graphs import (
    CONVOLUTIONS,
    CORRECTION_PX,
    CROP,
    DENSE,
    PLANES_OUT,
    REDUCED,
    Weights,
    cell_places,
    weight_shapes,
)
from phibench.estimator.learned.network_input import PLANES, SCALARS, SIDE_PX, VIEWS, WINDOW_PX, CropView, crop_input
from phibench.estimator.learned.networks import (
    INSTALL_TRAINING,
    MIDDLE_PX,
    Network,
    NetworkError,
    covariances,
    write_network,
)
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator

HELD_OUT = 20  # rooms
RESCALED = 6000  # crops that a scale alone is taken from
POOL_SEED = 5  # of the crops, which networks of all seeds share
REQUESTS: Mapping[str, Sequence[Mapping[str, Any]]] = {
    "bayer-raw": [{"read_noise_e": noise} for noise in (2.0, 3.5, 5.0, 7.0)],
    "srgb8": [{"read_noise_e": noise} for noise in (2.0, 3.5, 5.0, 7.0)],
    # half of all crops: the hardest, and the most numbers to learn
    "mjpeg": [
        {"jpeg_quality": quality, "read_noise_e": noise}
        for quality, noise in ((40, 5.0), (50, 2.0), (60, 7.0), (70, 3.5), (77, 5.0), (84, 2.0), (91, 7.0), (97, 3.5))
    ],
}
Parameters = dict[str, Any]  # torch.Tensor by name


@dataclass(frozen=True)
class TrainingSettings:
    """Choices of a training run.

    Parameters
    ----------
    seed : int
        Of first weights, order and flips. Seed k holds out the k-th twenty of the rooms, in one drawn order.
    presets : tuple of keys of `REQUESTS`
    crops : int
        Crops of all rooms; those of the rooms held out give the covariance's scale.
    passes : int
        Times that crops are used, each time flipped anew.
    views : int
        Places of the window of 32 pixels in each crop.
    batch : int
    rate : float
        Largest step of Adam.
    without_off : float
        Part of the crops without a laser-off image.
    """

    seed: int = 0
    presets: tuple[str, ...] = tuple(REQUESTS)
    crops: int = 30_000
    passes: int = 28
    views: int = 2
    batch: int = 64
    rate: float = 2e-3
    without_off: float = 0.15

    @property
    def options(self) -> tuple[FrameOptions, ...]:
        """Options of the crops, each drawn as often."""
        return tuple(
            FrameOptions(preset, {"exposure": "auto", **numbers})
            for preset in self.presets
            for numbers in REQUESTS[preset]
        )


_REACH_PX = 2.6  # of the spot, from the middle of a view
CROP_SETTINGS = CropSettings(side_px=SIDE_PX + 10, spread_px=2.5, laser_levels=(0.15, 3.0))


def rooms_of(folder: Path, seed: int) -> tuple[list[str], list[str]]:
    """Samples that are trained on, and those of the rooms that seed `seed` holds out."""
    rows = open_finished(folder).rows
    rooms = sorted({row.room for row in rows})
    if len(rooms) <= HELD_OUT:
        raise DatasetError(f"{folder}: has {len(rooms)} rooms; training holds {HELD_OUT} out and needs more than that")
    order = [rooms[k] for k in generator("learned", "rooms").permutation(len(rooms))]
    first = seed * HELD_OUT % (len(rooms) - HELD_OUT + 1)
    held = set(order[first : first + HELD_OUT])
    parts: tuple[list[str], list[str]] = ([], [])
    for row in rows:
        parts[row.room in held].append(row.sample_id)
    return parts


def crops_of(
    folder: Path, settings: TrainingSettings, samples: Sequence[str], length: int, seed: int, **numbers: Any
) -> SpotCrops:
    """Crops with and without the laser, of some samples; `numbers` change `CROP_SETTINGS`."""
    chosen = replace(CROP_SETTINGS, **numbers)
    return SpotCrops([folder], settings.options, length, seed=seed, settings=chosen, samples=samples, laser_off=True)


# -- items -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Items:
    """Inputs and places of n views of 33 x 33 pixels, red at their four corners.

    Attributes
    ----------
    planes : shape (n, 4, 33, 33), float16
    scalars : shape (n, 9)
    uv_px : shape (n, 2)
    turned : shape (n,), bool
        Whether rows may become columns: not of JPEG with chroma of half the width.
    samples : shape (n,)
        Where they come from.
    """

    planes: NDArray[np.float16]
    scalars: NDArray[np.float32]
    uv_px: NDArray[np.float32]
    turned: NDArray[np.bool_]
    samples: NDArray[np.str_]

    def of(self, samples: Sequence[str]) -> Items:
        """Those of some samples."""
        chosen = np.flatnonzero(np.isin(self.samples, list(samples)))
        return Items(*(column[chosen] for column in vars(self).values()))

    def flipped(self, rows: NDArray[Any], draw: np.random.Generator) -> tuple[Array, Array, Array]:
        """Planes (n, 4, 32, 32), scalars and places of some items, each mirrored and turned by chance."""
        planes, uv = self.planes[rows].astype(np.float32), self.uv_px[rows].copy()
        left, top, turn = draw.random((3, len(rows))) < 0.5
        turn &= self.turned[rows]
        planes[left], uv[left, 0] = planes[left][..., ::-1], SIDE_PX - uv[left, 0]
        planes[top], uv[top, 1] = planes[top][..., ::-1, :], SIDE_PX - uv[top, 1]
        planes[turn], uv[turn] = np.swapaxes(planes[turn], 2, 3), uv[turn][:, ::-1]
        return np.ascontiguousarray(planes[..., :SIDE_PX, :SIDE_PX]), self.scalars[rows], uv


def items_of(crops: SpotCrops, settings: TrainingSettings) -> Items:
    """Views of all crops; some of them without laser-off image."""
    views, side = settings.views, WINDOW_PX
    n = len(crops) * views
    planes, scalars = np.empty((n, PLANES, side, side), np.float16), np.empty((n, SCALARS), np.float32)
    rest: list[tuple[Array, bool, str]] = []
    draw = generator("learned", "views", crops.seed)
    for k in range(len(crops)):
        crop = crops.crop(k)
        for _ in range(views):
            first = _first_px(crop, draw)
            part = tuple(slice(x, x + side) for x in first[::-1])
            off = None if draw.random() < settings.without_off else crop.image_off
            made = crop_input(crop.image[part], None if off is None else off[part], crop.card, crop.response)
            planes[len(rest)], scalars[len(rest)] = made.planes, made.scalars
            rest.append((crop.uv_px - first, crop.card.output != "mjpeg", crop.sample_id))
    uv, turned, samples = (np.array(column) for column in zip(*rest, strict=True))
    return Items(planes, scalars, uv.astype(np.float32), turned, samples)


def _first_px(crop: Crop, draw: np.random.Generator) -> NDArray[np.int64]:
    """First column and row of a view: red, with the spot near its middle."""
    first = []
    for axis in (0, 1):
        starts = np.arange(crop.phase_px[axis] % 2, crop.image.shape[1 - axis] - SIDE_PX, 2)
        distance = np.abs(crop.uv_px[axis] - starts - (SIDE_PX - 1) / 2.0)
        near = starts[distance <= max(_REACH_PX, distance.min())]
        first.append(int(near[draw.integers(len(near))]))
    return np.array(first)


# -- the network of crops --------------------------------------------------------------------------------------------

_FIRST_LN = math.log(1.0 / 0.3)  # of the precision's factor: 0.3 px
_FAR = 4.0  # claimed deviations
_LED = 0.05  # of the steps


def first_crop_weights(seed: int) -> Weights:
    """Weights before training (He's law), by name: "<layer>.w" and "<layer>.b"."""
    draw = generator("learned", "crop weights", seed)
    weights: Weights = {}
    for name, of, side, _ in CONVOLUTIONS:
        weights |= first_layer(draw, name, (PLANES_OUT, of, side, side))
    weights |= first_layer(draw, "cells", (3, PLANES_OUT, 1, 1), 0.3)
    weights |= first_layer(draw, "less", (REDUCED, PLANES_OUT, 1, 1))
    for name, of, to in DENSE:
        weights |= first_layer(draw, name, (of, to), 0.1 if name in ("f2", "d2") else 1.0, axis=0)
    weights["f2.b"][:PLANES_OUT] = 1.0
    weights["d2.b"][[2, 4]] = _FIRST_LN
    return weights


def first_layer(
    draw: np.random.Generator, name: str, shape: tuple[int, ...], gain: float = 1.0, axis: int | None = None
) -> Weights:
    """Weights of one layer before training, by He's law, and zeros; `axis` is that of the inputs of a matrix."""
    inputs = math.prod(shape[1:]) if axis is None else shape[axis]
    outputs = shape[0] if axis is None else shape[1 - axis]
    weights = gain * math.sqrt(2.0 / inputs) * draw.standard_normal(shape)
    return {f"{name}.w": weights.astype(np.float32), f"{name}.b": np.zeros(outputs, np.float32)}


def crop_forward(torch: Any, p: Parameters, planes: Any, scalars: Any) -> tuple[Any, Any]:
    """Places (n, 2) and factors (n, 3) of crops, as `networks.covariances` takes them."""
    f, x = torch.nn.functional, planes
    film = f.relu(scalars @ p["f1.w"] + p["f1.b"]) @ p["f2.w"] + p["f2.b"]
    gain, shift = film[:, :, None, None].split(PLANES_OUT, dim=1)
    for name, _, _, stride in CONVOLUTIONS:
        x = f.conv2d(x, p[f"{name}.w"], p[f"{name}.b"], stride=stride)
        x = f.relu(x * gain + shift if name == "c1" else x)
    cells = f.conv2d(x, p["cells.w"], p["cells.b"]).flatten(2)
    weight = torch.softmax(cells[:, :1], dim=2)
    uv = (weight * (cells[:, 1:] + torch.from_numpy(cell_places()))).sum(2)
    less = f.relu(f.conv2d(x, p["less.w"], p["less.b"])).flatten(1)
    pooled = torch.cat([(weight * x.flatten(2)).sum(2), less, scalars], dim=1)
    y = f.relu(pooled @ p["d1.w"] + p["d1.b"]) @ p["d2.w"] + p["d2.b"]
    return uv + CORRECTION_PX * y[:, :2], y[:, 2:]


def gaussian_loss(torch: Any, uv: Any, factor: Any, true: Any) -> Any:
    """Negative log likelihood of places, without its constant; shape (n,)."""
    e, (a, b, c) = uv - true, factor.unbind(1)
    along, across = torch.exp(a) * e[:, 0] + b * e[:, 1], torch.exp(c) * e[:, 1]
    q = along**2 + across**2
    far = 2.0 * _FAR * torch.sqrt(q.clamp(min=_FAR**2)) - _FAR**2
    return 0.5 * torch.where(q < _FAR**2, q, far) - a - c


def train_crop(items: Items, settings: TrainingSettings, checks: Items | None = None) -> Weights:
    """Weights after training on some items; errors of other ones are told four times on the way."""
    torch = torch_on_one_thread()
    p = {name: torch.tensor(value, requires_grad=True) for name, value in first_crop_weights(settings.seed).items()}
    draw, each, total = generator("learned", "batches", settings.seed), len(items.planes) // settings.batch, []
    steps = AdamSteps(torch, p, settings.rate, settings.passes * each)
    for number in range(settings.passes):
        order = draw.permutation(len(items.planes))
        for k in range(each):
            batch = items.flipped(order[k * settings.batch : (k + 1) * settings.batch], draw)
            given, numbers, true = (torch.from_numpy(np.ascontiguousarray(part)) for part in batch)
            given = given.contiguous(memory_format=torch.channels_last)
            uv, factor = crop_forward(torch, p, given, numbers)
            # a likelihood first widens what it does not know yet: the distance itself leads at the beginning
            lead = torch.nn.functional.smooth_l1_loss(uv, true, beta=0.1) if steps.share < _LED else 0.0
            total.append(steps.step(gaussian_loss(torch, uv, factor, true).mean() + 10.0 * lead))
        _say(f"pass {number + 1}: loss {np.mean(total[-each:]):.3f}, {time.process_time() / 60.0:.1f} CPU-min")
        if checks is not None and (number + 1) % max(settings.passes // 4, 1) == 0:
            _say(f"  rooms held out: {_told(answers_of(_plain(p), checks))}")
    return _plain(p)


def _plain(p: Parameters) -> Weights:
    return {name: value.detach().numpy().copy() for name, value in p.items()}


def _told(answers: Answers) -> str:
    """Loss and errors in words: the mean of ln of a distance weighs bright spots as faint ones."""
    if not answers.sure.any():
        return "no claim below a pixel"
    distance = np.hypot(*answers.error_px.T)
    a = -0.5 * np.log(np.linalg.det(answers.covariance_px2))
    loss = float((np.minimum(answers.squared_pull, _TAIL) - a).mean())
    sure = distance[answers.sure]
    return (
        f"loss {loss:.3f}; claims below a pixel {answers.sure.mean():.3f}: rms {np.sqrt((sure**2).mean()):.4f}, median "
        f"{np.median(sure):.4f} px; geometric mean of all {np.exp(np.log(distance).mean()):.4f} px"
    )


class AdamSteps:
    """Adam with a rate that rises over 5 % of the steps and falls as a cosine; gradients are cut at a norm of 5."""

    def __init__(self, torch: Any, p: Parameters, rate: float, steps: int) -> None:
        self._torch, self._p, self._rate, self._steps, self._done = torch, list(p.values()), rate, max(steps, 1), 0
        self._adam = torch.optim.Adam(self._p, lr=rate)

    @property
    def share(self) -> float:
        """Part of the steps that is done."""
        return self._done / self._steps

    def step(self, loss: Any) -> float:
        """Take one step down."""
        share = self.share
        self._adam.param_groups[0]["lr"] = self._rate * min(share / 0.05 + 1e-3, 0.5 + 0.5 * math.cos(math.pi * share))
        self._adam.zero_grad()
        loss.backward()
        self._torch.nn.utils.clip_grad_norm_(self._p, 5.0)
        self._adam.step()
        self._done += 1
        return float(loss.detach())


# -- the covariance's scale ------------------------------------------------------------------------------------------

_SURE_PX = 1.0  # claimed deviation of crops that count: detection finds no spot that is fainter
_TAIL = 25.0  # of a squared pull: a scale for most spots, not for the worst


@dataclass(frozen=True)
class Answers:
    """Answers of a network for n crops: errors (n, 2), covariances (n, 2, 2)."""

    error_px: Array
    covariance_px2: Array

    @property
    def squared_pull(self) -> Array:
        """e^T C^-1 e / 2, shape (n,): mean 1."""
        return np.asarray(
            np.einsum("ni,nij,nj->n", self.error_px, np.linalg.inv(self.covariance_px2), self.error_px) / 2
        )

    @property
    def sure(self) -> NDArray[np.bool_]:
        """Claimed deviation below a pixel, shape (n,)."""
        return np.asarray(np.trace(self.covariance_px2, axis1=1, axis2=2) < 2.0 * _SURE_PX**2)


def answers_of(weights: Weights, items: Items, view: CropView = VIEWS[0]) -> Answers:
    """Answers for a view of items, turned back; without a scale of the covariance."""
    torch = torch_on_one_thread()
    p = {name: torch.from_numpy(value) for name, value in weights.items()}
    with torch.no_grad():
        parts = [
            crop_forward(torch, p, *map(torch.from_numpy, (planes, items.scalars[k : k + 256])))
            for k in range(0, len(items.planes), 256)
            for planes in [np.ascontiguousarray(view.of(items.planes[k : k + 256]), np.float32)]
        ]
    uv, factor = (np.concatenate([part[k].numpy() for part in parts]).astype(float) for k in (0, 1))
    turn = view.matrix
    error = (uv - MIDDLE_PX) @ turn - (items.uv_px - MIDDLE_PX)
    return Answers(error, turn.T @ covariances(factor, 1.0) @ turn)


def mean_answers(weights: Weights, items: Items) -> Answers:
    """Answers for items, means over their views as of `Network.position`."""
    shown = np.array([items.turned | (not view.turned) for view in VIEWS], float)
    shown /= shown.sum(axis=0)
    every = [answers_of(weights, items, view) for view in VIEWS]
    error = np.einsum("vn,vni->ni", shown, [one.error_px for one in every])
    return Answers(error, np.einsum("vn,vnij->nij", shown, [one.covariance_px2 for one in every]))


def scale_of(answers: Answers) -> float:
    """Scale of the covariance with which squared pulls, cut at 25, have the mean 1."""
    pulls = answers.squared_pull[answers.sure]
    scale = float(pulls.mean()) if pulls.size else 1.0
    for _ in range(20):
        scale = float(np.minimum(pulls / scale, _TAIL).mean()) * scale if pulls.size else 1.0
    return scale


# -- from the command line -------------------------------------------------------------------------------------------


def train(folder: Path, out: Path, settings: TrainingSettings) -> Path:
    """Train `learned_crop` and write its file."""
    torch_on_one_thread()
    seen, held = rooms_of(folder, settings.seed)
    items = items_of(crops_of(folder, settings, seen + held, settings.crops, POOL_SEED), settings)
    _say(f"{settings.crops} crops: {time.process_time() / 60.0:.1f} CPU-min")
    return train_on(items, seen, held, out, settings)


def train_on(items: Items, seen: Sequence[str], held: Sequence[str], out: Path, settings: TrainingSettings) -> Path:
    """Train on views of some samples, take the covariance's scale from others, and write the file."""
    checks, given = items.of(held), items.of(seen)
    if len(given.planes) < settings.batch or not len(checks.planes):
        raise NetworkError(
            f"{settings.crops} crops are too few for training and {HELD_OUT} rooms held out: ask for more --crops"
        )
    weights = train_crop(given, settings, checks)
    entries = {"settings": json.dumps(asdict(settings), sort_keys=True)}
    return write_network(out, CROP, weights, entries | {"covariance_scale": _scale(weights, checks)})


def _scale(weights: Weights, checks: Items) -> float:
    answers = mean_answers(weights, checks)
    if not answers.sure.any():
        raise NetworkError("no spot of the rooms held out is claimed to a pixel: train on more --crops or --passes")
    scale = scale_of(answers)
    pull = np.sqrt(answers.squared_pull[answers.sure].mean() / scale)
    _say(f"rooms held out, mean of views: {_told(answers)}, rms pull {pull:.2f}, scale {scale:.2f}")
    return scale


def rescaled(folder: Path, network: Path, out: Path, settings: TrainingSettings) -> Path:
    """Write a network of crops with a covariance's scale from crops of the rooms that its seed held out."""
    model = read_model(InputFile(network, "train it: docs/learned.md", NetworkError, MIB).read())
    held = rooms_of(folder, settings.seed)[1]
    checks = items_of(crops_of(folder, settings, held, RESCALED, POOL_SEED), settings)
    Network(network, CROP)  # refuses what is none
    weights = {name: model.tensors[name].copy() for name in weight_shapes(CROP)}
    kept = {key: value for key, value in model.metadata.items() if key not in ("name", "version", "sha256")}
    return write_network(out, CROP, weights, kept | {"covariance_scale": _scale(weights, checks)})


def torch_on_one_thread() -> Any:
    """PyTorch, on one thread: several would add up in another order."""
    try:
        import torch
    except ImportError as error:
        raise NetworkError(f"training needs PyTorch: {INSTALL_TRAINING}") from error
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    return torch


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def one_or_more(text: str) -> int:
    """Whole number from 1 up, of a command line.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is none.
    """
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: must be a whole number from 1 up")
    return int(text)


def exit_code_of(made: Callable[[], Path]) -> int:
    """Make a file and print its name, or what is wrong; exit code."""
    try:
        print(made())
    except DatasetError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Train a network from the command line."""
    parser = argparse.ArgumentParser("python -m tools.crop_training", description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="finished data set")
    parser.add_argument("--out", type=Path, required=True, help="file to write, .onnx")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--preset", action="append", choices=list(REQUESTS), help="may be given again; all by default")
    parser.add_argument("--crops", type=one_or_more, default=TrainingSettings.crops, help="of all rooms")
    told_passes = f"times that the crops are used; {TrainingSettings.passes} by default"
    parser.add_argument("--passes", type=one_or_more, default=TrainingSettings.passes, help=told_passes)
    parser.add_argument("--rescale", type=Path, metavar="FILE", help="a network that only gets a new covariance scale")
    given = parser.parse_args(arguments)
    settings = TrainingSettings(given.seed, tuple(given.preset or REQUESTS), given.crops, given.passes)
    if given.rescale is None:
        return exit_code_of(lambda: train(given.folder, given.out, settings))
    return exit_code_of(lambda: rescaled(given.folder, given.rescale, given.out, settings))


if __name__ == "__main__":
    sys.exit(main())
