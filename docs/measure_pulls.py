"""Pulls by strata from the files of scores: `measure_pulls.py FOLDER [--methods raw_maximum_likelihood joint_fit]`.

Run from the repository root. FOLDER holds what `phibench bench` wrote: `<preset>-<method>.json` and its records.
`<preset>-detect.json` gives the distance of a fit from the detection. A table per preset and method: answers within
3 px with a claimed covariance, their samples, the rms pull about the centre of the light and about the beam's axis with
95 % intervals (bootstrap over samples), rms at the bound over rms, and the share of all claims that are off by more
than 5 claimed sigma, answers beyond 3 px included. Strata: shift between light and axis, saturation, signal to noise,
claimed sigma, distance from the detection, and saturation within each of the others. A stratum of fewer than 30 answers
is not shown.
Above each table: of images in which `detect` is within 1 px, how many the method answers, and how many beyond 3 px.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import polars as pl

from phibench.benchmark.scores.answer_errors import whitened_errors
from phibench.benchmark.scores.metrics import FAR_SIGMAS
from phibench.benchmark.scores.score_files import read_records, read_score
from phibench.benchmark.scores.strata import light_shift

LEAST = 30
RESAMPLES = 1999
METHODS = ("raw_maximum_likelihood", "chain_fit", "joint_fit")
EDGES = {
    "shift": ("shift_px", (0.0, 0.001, 0.01, 0.04, math.inf), "px"),
    "snr": ("snr", (0.0, 5.0, 10.0, 30.0, 100.0, math.inf), ""),
    "claimed": ("claimed_px", (0.0, 0.02, 0.05, 0.1, 0.2, math.inf), "px"),
    "from detect": ("from_detect_px", (0.0, 0.3, 1.0, 3.0, math.inf), "px"),
}


def claims_of(folder: Path, preset: str, method: str) -> pl.DataFrame:
    """Records of visible spots with an answer and a claim, and what the strata are made of."""
    records = _records(folder / f"{preset}-{method}.json")
    table = records.filter(pl.col("visible") & pl.col("mahalanobis2").is_not_null())
    error = table.select(pl.col("u_px") - pl.col("u_axis_px"), pl.col("v_px") - pl.col("v_axis_px")).to_numpy()
    uu, uv, vv = (table[f"claimed_{name}_px2"].to_numpy() for name in ("uu", "uv", "vv"))
    pulls = whitened_errors(error, np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2))
    table = table.with_columns(
        shift_px=light_shift(),
        claimed_px=(0.5 * (pl.col("claimed_uu_px2") + pl.col("claimed_vv_px2"))).sqrt(),
        light2=0.5 * pl.col("mahalanobis2"),
        axis2=pl.Series(0.5 * np.sum(pulls**2, axis=-1)),
        saturation=pl.when(pl.col("saturated")).then(pl.lit("saturated")).otherwise(pl.lit("not saturated")),
        from_detect_px=pl.lit(None, pl.Float64),
    )
    detect = folder / f"{preset}-detect.json"
    if not detect.is_file():
        return table
    found = _records(detect).select("number", "image", u_detect="u_px", v_detect="v_px")
    du, dv = (pl.col(f"{x}_px") - pl.col(f"{x}_detect") for x in "uv")
    return table.join(found, on=("number", "image"), how="left").with_columns(from_detect_px=(du**2 + dv**2).sqrt())


def _records(path: Path) -> pl.DataFrame:
    return read_records(path, read_score(path))


def lost_detections(folder: Path, preset: str, method: str) -> str:
    """What becomes of the spots that `detect` finds within 1 px; empty where it has no score here."""
    detect = folder / f"{preset}-detect.json"
    if not detect.is_file():
        return ""
    right = _records(detect).filter(pl.col("visible") & (pl.col("distance_px") <= 1.0)).select("number", "image")
    answers = _records(folder / f"{preset}-{method}.json").join(right, on=("number", "image"), how="semi")
    off = answers["distance_px"].drop_nulls()
    worst = f"; farthest {off.max():.2f} px" if len(off) else ""
    return f"detect within 1 px: {len(right)} images, answers {len(off)}, beyond 3 px {int((off > 3.0).sum())}{worst}"


def strata_of(table: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
    """Parts of the claims with their names."""
    yield "all", table
    for name in ("saturated", "not saturated"):
        part = table.filter(saturation=name)
        yield name, part
    for by, (column, edges, unit) in EDGES.items():
        for low, high in pairwise(edges):
            inside = table.filter((pl.col(column) >= low) & (pl.col(column) < high))
            label = f"{by} {low:g} to {high:g} {unit}".strip() if math.isfinite(high) else f"{by} from {low:g} {unit}"
            yield label.strip(), inside
            for name in ("saturated", "not saturated"):
                yield f"{label.strip()}, {name}", inside.filter(saturation=name)


def rms_of(part: pl.DataFrame, column: str, rng: np.random.Generator) -> str:
    """Rms pull with its interval by the bootstrap over samples."""
    sums = part.group_by("sample_id").agg(pl.col(column).sum(), pl.len()).sort("sample_id")
    squares, counts = sums[column].to_numpy(), sums["len"].to_numpy()
    index = rng.integers(0, len(sums), (RESAMPLES, len(sums)))
    drawn = np.sqrt(squares[index].sum(axis=1) / counts[index].sum(axis=1))
    low, high = np.quantile(drawn, (0.025, 0.975))
    return f"{math.sqrt(squares.sum() / counts.sum()):.2f} [{low:.2f}, {high:.2f}]"


def row_of(label: str, part: pl.DataFrame, rng: np.random.Generator) -> str:
    """Line of a table."""
    near = part.filter("detected")
    far = int((part["mahalanobis2"] > FAR_SIGMAS**2).sum())
    cells = [label, str(len(near)), str(near["sample_id"].n_unique())]
    if len(near) < LEAST:
        return "| " + " | ".join([*cells, "not shown", "not shown", "not shown", f"{far} of {len(part)}"]) + " |"
    bounded = near.filter(pl.col("bound_px2").is_not_null())
    efficiency = math.sqrt(bounded["bound_px2"].sum() / max((bounded["distance_px"] ** 2).sum(), 1e-300))
    pulls = [rms_of(near, column, rng) for column in ("light2", "axis2")]
    return "| " + " | ".join([*cells, *pulls, f"{efficiency:.2f}", f"{far} of {len(part)}"]) + " |"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    given = parser.parse_args()
    for path in sorted(given.folder.glob("*.json")):
        preset, _, method = path.stem.rpartition("-")
        if method not in given.methods:
            continue
        table, rng = claims_of(given.folder, preset, method), np.random.default_rng(0)
        if not len(table):
            continue
        shift = table["shift_px"].drop_nulls()
        print(
            f"\n{preset}, {method}: light {shift.median():.2g} px from the axis (median), {shift.max():.2g} at worst\n"
        )
        print(f"{lost_detections(given.folder, preset, method)}\n")
        print("| stratum | answers | samples | pull, light | pull, axis | bound / rms | beyond 5 sigma |")
        print("|---|---|---|---|---|---|---|")
        for label, part in strata_of(table):
            print(row_of(label, part, rng))


if __name__ == "__main__":
    main()
