"""Worst images of a run, with the pictures that a report shows of them: a report needs no data set.

Each has a crop around the spot, and the first ones the whole frame at half its size. Pictures are 8 bits, brightened
for the eye. Positions are those of the whole frame: integer (u, v) are pixel centres.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.datasets.store.schema import Document
from phibench.estimator.pair_set import Pairs
from phibench.estimator.spots.camera_codes import rgb_picture
from phibench.scenes.frames import Array

CROP_PX = 48  # a spot and what is around it
COUNT = 10  # of a score's images
FRAMES = 3
"""Images that are also shown whole."""
_DARKEST, _BRIGHTEST = 0.5, 99.8  # percentiles of a frame: black, and white; the spot and lamps are the rest
_GAMMA = 1.0 / 2.2  # raw pixels are linear in the light
_JPEG_QUALITY = 70  # of frames in the report: to look at, not to measure


def worst_images(
    records: pl.DataFrame, pairs: Pairs, count: int = COUNT, before: pl.DataFrame | None = None
) -> list[Worst]:
    """Worst images first: wrong positions by distance, then no position, then detected spots by distance.

    Only visible spots, and one image of a sample: ten draws of one spot would show one thing ten times. `before` are
    `worst_records` of the parts before: what is not among the worst together with them will not be in the end.
    """
    own = set(records["number"])
    rows = worst_records(records, count, before).iter_rows(named=True)
    return [_entry(row, pairs, place < FRAMES) for place, row in enumerate(rows) if row["number"] in own]


def worst_records(records: pl.DataFrame, count: int = COUNT, before: pl.DataFrame | None = None) -> pl.DataFrame:
    """Records of the worst images, and of those before."""
    return _ranked(records if before is None else pl.concat([before.select(records.columns), records])).head(count)


def worst_of(records: pl.DataFrame, entries: Sequence[Worst], count: int = COUNT) -> list[Worst]:
    """Worst images of all records, out of the worst ones of their parts."""
    known = {(entry.number, entry.image): entry for entry in entries}
    rows = _ranked(records).head(count).select("number", "image").iter_rows()
    ordered = [known[number, image] for number, image in rows]
    return [one if place < FRAMES else one.model_copy(update={"frame": None}) for place, one in enumerate(ordered)]


def crop(image: NDArray[Any], uv_px: Array, side_px: int = CROP_PX) -> tuple[NDArray[np.uint8], tuple[int, int]]:
    """Part of an image around a position, 8 bits, stretched to its own darkest and brightest value.

    Returns
    -------
    pixels : shape (h, w) or (h, w, 3)
    origin : (u, v) of the first column and row
    """
    u, v = (int(x) for x in np.floor(uv_px + 0.5) - side_px // 2)
    u0, v0 = max(u, 0), max(v, 0)
    pixels = np.asarray(image[v0 : max(v + side_px, 0), u0 : max(u + side_px, 0)], float)
    low, high = (pixels.min(), pixels.max()) if pixels.size else (0.0, 1.0)
    return np.round(255.0 * (pixels - low) / max(high - low, 1e-9)).astype(np.uint8), (u0, v0)  # an even crop is black


def half_size(image: NDArray[Any], card: SensorCard) -> NDArray[np.uint8]:
    """Frame at half its size, 8 bits, shape (h, w) of a sensor without filters, else (h, w, 3)."""
    height, width = (size // 2 * 2 for size in image.shape[:2])
    whole = image[:height, :width]
    red, green, other, blue = (np.asarray(whole[v::2, u::2], float) for v in (0, 1) for u in (0, 1))
    if card.output != "raw" or card.mosaic == "mono":
        mean = (red + green + other + blue) / 4.0
        return _brightened(mean) if card.output == "raw" else np.asarray(np.round(mean), np.uint8)
    return _brightened(np.stack([red, 0.5 * (green + other), blue], axis=-1))


def _brightened(values: Array) -> NDArray[np.uint8]:
    low, high = np.percentile(values, [_DARKEST, _BRIGHTEST])
    share = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)  # an even frame is black
    return np.round(255.0 * share**_GAMMA).astype(np.uint8)


def _ranked(records: pl.DataFrame) -> pl.DataFrame:
    """One image of each sample, the worst first."""
    rank = pl.when(pl.col("detected")).then(0).when(pl.col("distance_px").is_null()).then(1).otherwise(2)
    return (
        records.filter(pl.col("visible") & pl.col("u_true_px").is_not_null())
        .with_columns(rank=rank)
        .sort("rank", "distance_px", "number", "image", descending=[True, True, False, False], nulls_last=True)
        .unique("sample_id", keep="first", maintain_order=True)
    )


def _entry(row: dict[str, Any], pairs: Pairs, whole: bool) -> Worst:
    pair = pairs.pair(row["number"])
    image, true_px = rgb_picture(getattr(pair, row["image"]), pair.card), (row["u_true_px"], row["v_true_px"])
    pixels, origin = crop(image, np.array(true_px))
    return Worst(
        **{
            name: row[name]
            for name in ("number", "sample_id", "image", "depth_m", "electrons", "distance_px", "status", "cause")
        },
        true_px=true_px,
        answer_px=None if row["u_px"] is None else (row["u_px"], row["v_px"]),
        crop=_encoded(pixels, "png", origin, 1) if pixels.size else None,
        frame=_encoded(half_size(image, pair.card), "jpeg", (0, 0), 2) if whole else None,
    )


def _encoded(
    pixels: NDArray[np.uint8], kind: Literal["png", "jpeg"], first_px: tuple[int, int], step_px: int
) -> EncodedPicture:
    buffer = io.BytesIO()
    options: dict[str, Any] = {"quality": _JPEG_QUALITY} if kind == "jpeg" else {}
    Image.fromarray(pixels).save(buffer, format=kind, optimize=True, **options)
    return EncodedPicture(
        kind=kind,
        first_px=first_px,
        step_px=step_px,
        size=(pixels.shape[1], pixels.shape[0]),
        base64=base64.b64encode(buffer.getvalue()).decode("ascii"),
    )


class EncodedPicture(Document):
    """Part of a frame as a picture: (u, v) lies at ((u - first_u + 0.5) / step, ...) from its upper left corner."""

    kind: Literal["png", "jpeg"]
    first_px: Annotated[tuple[int, int], Field(strict=False)]
    step_px: int = Field(description="pixels of the frame along a side of one of the picture")
    size: Annotated[tuple[int, int], Field(strict=False)]
    base64: str

    def place(self, uv_px: tuple[float, float]) -> tuple[float, float]:
        """Position in the picture, from its upper left corner."""
        u, v = ((x - first + 0.5) / self.step_px for x, first in zip(uv_px, self.first_px, strict=True))
        return u, v

    def holds(self, uv_px: tuple[float, float]) -> bool:
        """Tell whether a position of the frame lies in the picture."""
        return all(0.0 <= x <= size for x, size in zip(self.place(uv_px), self.size, strict=True))


class Worst(Document):
    """One of the worst images; positions are those of the whole frame."""

    number: int
    sample_id: str
    image: Literal["down", "up"]
    depth_m: float
    electrons: float
    distance_px: float | None
    status: str
    cause: str | None
    true_px: Annotated[tuple[float, float], Field(strict=False)]
    answer_px: Annotated[tuple[float, float] | None, Field(strict=False)]
    crop: EncodedPicture | None = Field(description="around the spot, stretched to its own range")
    frame: EncodedPicture | None = Field(description="the whole; of the first ones only")
