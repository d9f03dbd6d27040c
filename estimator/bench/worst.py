"""The worst images of a run, each with a small crop that lies in the score: a report needs no data set."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray
from PIL import Image

from phibench.estimator.bench.document import Worst
from phibench.estimator.seat.pair import Pair
from phibench.scenes.frames import Array

CROP_PX = 48
COUNT = 10


def worst(records: pl.DataFrame, draw: Callable[[int], Pair], count: int = COUNT) -> list[Worst]:
    """Worst images first: wrong positions by distance, then no position, then detected spots by distance.

    Only visible spots, and one image of a sample: ten draws of one spot would show one thing ten times.
    """
    return [_entry(row, draw) for row in _ranked(records).head(count).iter_rows(named=True)]


def worst_of(records: pl.DataFrame, entries: Sequence[Worst], count: int = COUNT) -> list[Worst]:
    """Worst images of all records, out of the worst ones of their parts."""
    known = {(entry.number, entry.image): entry for entry in entries}
    rows = _ranked(records).head(count).select("number", "image").iter_rows()
    return [known[number, image] for number, image in rows]


def _ranked(records: pl.DataFrame) -> pl.DataFrame:
    """One image of each sample, the worst first."""
    rank = pl.when(pl.col("detected")).then(0).when(pl.col("distance_px").is_null()).then(1).otherwise(2)
    return (
        records.filter(pl.col("visible"))
        .with_columns(rank=rank)
        .sort("rank", "distance_px", "number", "image", descending=[True, True, False, False], nulls_last=True)
        .unique("sample_id", keep="first", maintain_order=True)
    )


def crop(image: NDArray[Any], uv_px: Array, side_px: int = CROP_PX) -> tuple[NDArray[np.uint8], tuple[int, int]]:
    """Part of an image around a position, 8 bits, stretched to its own darkest and brightest value.

    Returns
    -------
    pixels : shape (h, w) or (h, w, 3)
    origin : (u, v) of the first column and row
    """
    u, v = (int(x) for x in np.floor(uv_px + 0.5) - side_px // 2)
    u0, v0 = max(u, 0), max(v, 0)
    part = np.asarray(image[v0 : max(v + side_px, 0), u0 : max(u + side_px, 0)], float)
    low, high = (part.min(), part.max()) if part.size else (0.0, 1.0)
    return np.round(255.0 * (part - low) / max(high - low, 1e-9)).astype(np.uint8), (u0, v0)


def _entry(row: dict[str, Any], draw: Callable[[int], Pair]) -> Worst:
    true = np.array([row["u_true_px"], row["v_true_px"]])
    pixels, origin = crop(getattr(draw(row["number"]), row["image"]), true)
    answer = None if row["u_px"] is None else (row["u_px"] - origin[0], row["v_px"] - origin[1])
    return Worst(
        **{
            name: row[name]
            for name in ("number", "sample_id", "image", "depth_m", "electrons", "distance_px", "status")
        },
        cause=row["cause"],
        true_in_crop_px=(float(true[0] - origin[0]), float(true[1] - origin[1])),
        answer_in_crop_px=answer,
        size_px=(pixels.shape[1], pixels.shape[0]),
        png_base64=_png(pixels) if pixels.size else None,
    )


def _png(pixels: NDArray[np.uint8]) -> str:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", optimize=True)
    return base64.b64encode(buffer.getvalue()).decode("ascii")
