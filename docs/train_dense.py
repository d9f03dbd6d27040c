"""Train the network of `dense_learned`, and test what it gains over `dense_sweep` in other rooms.

Usage: python docs/train_dense.py features DATASET FILE.npz [EVERY WIDTH]
       python docs/train_dense.py fit FILE.npz [WEIGHTS.npz]     (needs PyTorch)

Features of 6000 random pixels of each room that both images show: cost curves around the sweep's answer before and
after aggregation, the fit's sigma and way, its neighbours, place and stroke. The network answers a correction of 1 / D
and a scale of the error. Each room is tried by a network that has not seen it. All ways keep the same number of answers
in each room, those with the least claims.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from measure_dense_stroke import pair_of

from phibench.datasets.read import open_dataset
from phibench.estimator.dense.learned_sweep import LARGEST, LEARNED_WIDTH_PX, SweepNetwork, features_of
from phibench.estimator.dense.sweep import SweepParts, dense_sweep
from phibench.estimator.dense.unrolled_pair import UnrolledPair

PIXELS = 6000  # of a room
RECALLED = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
FOLDS, EPOCHS, BATCH, RATE, WIDTH = 5, 12, 2048, 3e-3, 64
WORST = 0.1  # scale of answers, as of the method
NAMES = ("matrix", "offset")


def features(folder: str, file: str, every: int, width_px: int) -> None:
    """Write features, relative target and the sweep's own answer of all rooms."""
    dataset = open_dataset(folder)
    parts: dict[str, list[Any]] = {}
    for room, number in enumerate(range(0, len(dataset), every)):
        begin = time.process_time()
        sample = dataset[number]
        one = of_room(pair_of(sample), sample.correspondence(), np.random.default_rng(number), width_px)
        one["room"] = np.full(len(one["base"]), room)
        for name, values in one.items():
            parts.setdefault(name, []).append(values)
        print(number, len(one["base"]), f"{time.process_time() - begin:.1f} CPU-s", flush=True)
        np.savez(file, **{name: np.concatenate(values) for name, values in parts.items()})


def of_room(pair: Any, truth: Any, rng: np.random.Generator, width_px: int) -> dict[str, Any]:
    """Features (n, 53), true and answered 1 / D, and the sweep's claim, relative, NaN where it gives no answer."""
    unrolled = UnrolledPair.of(pair, width_px)
    parts, answer = SweepParts.of((unrolled,)), dense_sweep(pair, width_px)
    index, _, place = unrolled._places
    height, width = unrolled.down.shape
    row = np.clip(np.rint(place[:, 1]).astype(int), 0, height - 1)
    column = np.rint(place[:, 0]).astype(int) % width
    usable = truth.seen.reshape(-1)[index] & unrolled.seen[row, column]
    pick = rng.permutation(np.flatnonzero(usable))[:PIXELS]
    base, pixels = unrolled.at_pixels(parts.fit.inverse)[pick], index[pick]
    assert answer.depth_m is not None
    assert answer.sigma_depth_m is not None
    return {
        "features": features_of(parts, row[pick], column[pick], base),
        "true": 1.0 / truth.depth_m.reshape(-1)[pixels],
        "base": base,
        "claim": answer.sigma_depth_m.reshape(-1)[pixels] / answer.depth_m.reshape(-1)[pixels],
    }


def fit(file: str, weights: str | None) -> None:
    """Train on four fifths of the rooms and try the others, five times; print the figures of all rooms.

    With a file for weights, train on all rooms, too.
    """
    data = np.load(file)
    begin, rows = time.process_time(), {}
    base = np.maximum(data["base"], 0.02)
    target = data["true"] / base - 1.0
    correction, scale = np.zeros(len(base)), np.ones(len(base))
    for fold in range(FOLDS):
        test = data["room"] % FOLDS == fold
        correction[test], scale[test] = trained(data["features"][~test], target[~test])(data["features"][test])
    rooms = np.unique(data["room"])
    print(f"{len(rooms)} rooms, {len(base)} pixels, {time.process_time() - begin:.0f} CPU-s for {FOLDS} networks")
    for room in rooms:
        here = data["room"] == room
        for name, values in of_ways(data["true"][here], base[here], data["claim"][here], correction[here], scale[here]):
            rows.setdefault(name, []).append(values)
    told(rows)
    ratio = np.abs(data["true"] / (base * (1.0 + correction)) - 1.0) / scale
    sure = scale < WORST
    print(
        f"scale below {WORST}: {100 * sure.mean():.1f} %; of their errors 95 % are below "
        f"{np.quantile(ratio[sure], 0.95):.2f} scales"
    )
    if weights is not None:
        network = trained(data["features"], target)
        pairs = {
            f"{name}{k}": part
            for k, layer in enumerate(network.layers)
            for name, part in zip(NAMES, layer, strict=True)
        }
        np.savez_compressed(weights, mean=network.mean, spread=network.spread, **pairs)


def trained(features: Any, target: Any) -> SweepNetwork:
    """Network of some pixels."""
    import torch

    torch.manual_seed(0)
    torch.set_num_threads(1)
    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-6
    inputs = torch.tensor(np.clip((features - mean) / spread, -6.0, 6.0), dtype=torch.float32)
    wanted = torch.tensor(np.clip(target, -0.5, 1.0), dtype=torch.float32)
    linear = [torch.nn.Linear(a, b) for a, b in pairwise((features.shape[1], WIDTH, WIDTH, 2))]
    net = torch.nn.Sequential(linear[0], torch.nn.SiLU(), linear[1], torch.nn.SiLU(), linear[2])
    optimiser = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=EPOCHS * (len(inputs) // BATCH + 1))
    for _ in range(EPOCHS):
        for batch in torch.split(torch.randperm(len(inputs)), BATCH):
            optimiser.zero_grad()
            shift, log_scale = net(inputs[batch]).unbind(dim=1)
            # density of Laplace: few errors are large, as in the sweep
            loss = ((wanted[batch] - LARGEST * torch.tanh(shift)).abs() * torch.exp(-log_scale) + log_scale).mean()
            loss.backward()
            optimiser.step()
            schedule.step()
    layers = tuple((layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in linear)
    return SweepNetwork(mean.astype(np.float32), spread.astype(np.float32), layers)


def of_ways(true: Any, base: Any, claim: Any, correction: Any, scale: Any) -> Iterator[tuple[str, list[float]]]:
    """Sweep, sweep with the network's scale, and with its correction, too: at the sweep's own share of answers.

    Values are median, recall, share above 10 %, AUSE and share answered.
    """
    count = int(np.isfinite(claim).sum())
    plain, moved = np.abs(true / base - 1.0), np.abs(true / (base * (1.0 + correction)) - 1.0)
    ways = {
        "dense_sweep": (plain, np.where(np.isfinite(claim), claim, np.inf)),
        "its answers, the network's scale": (plain, scale),
        "the network's answers and scale": (moved, scale),
    }
    for name, (error, key) in ways.items():
        kept = np.argsort(key, kind="stable")[:count]
        size = error[kept]
        recall = np.mean([np.count_nonzero(size <= limit) for limit in RECALLED]) / len(true)
        above = float(np.mean(size > 0.1))
        yield name, [float(np.median(size)), float(recall), above, ause(size, key[kept]), count / len(true)]


def told(rows: dict[str, list[list[float]]]) -> None:
    """Print means over rooms, and differences from the sweep with their intervals."""
    first = np.array(rows["dense_sweep"])
    for name, values in rows.items():
        table = np.array(values)
        _, recall, above, area, share = table.mean(axis=0)
        print(
            f"{name}: median {100 * np.median(table[:, 0]):.3f} %, recall {100 * recall:.2f} %, above 10 % "
            f"{100 * above:.2f} %, AUSE {area:.3f}, answered {100 * share:.1f} %"
        )
        if name != "dense_sweep":
            print("   median over the sweep's:", interval(table[:, 0] / first[:, 0], np.median))
            print("   recall less the sweep's, points:", interval(100.0 * (table[:, 1] - first[:, 1]), np.mean))
            print("   above 10 % less the sweep's, points:", interval(100.0 * (table[:, 2] - first[:, 2]), np.mean))
            print("   AUSE less the sweep's:", interval(table[:, 3] - first[:, 3], np.mean))


def interval(values: Any, of: Any) -> str:
    """Value over rooms with its interval."""
    draws = of(np.random.default_rng(1).choice(values, (4000, len(values))), axis=1)
    low, high = np.percentile(draws, [2.5, 97.5])
    return f"{of(values):.3f} ({low:.3f} to {high:.3f})"


def ause(error: Any, sigma: Any) -> float:
    """As `dense_records.ause`."""
    kept = np.maximum(np.round((1.0 - np.arange(100) / 100.0) * len(error)).astype(int), 1)
    curves = [np.cumsum(error[np.argsort(key, kind="stable")])[kept - 1] / kept for key in (sigma, error)]
    return float(np.trapezoid(curves[0] - curves[1], np.arange(100) / 100.0) / error.mean())


if __name__ == "__main__":
    if sys.argv[1] == "features":
        features(sys.argv[2], sys.argv[3], *(int(x) for x in sys.argv[4:6] or (3, LEARNED_WIDTH_PX)))
    else:
        fit(sys.argv[2], sys.argv[3] if len(sys.argv) > 3 else None)
