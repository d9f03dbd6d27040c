"""Calibration of a rig from imported real pictures: outlines, vertical edges, and spots at distances of a tape."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from phibench.calibration.captures.imported_set import ImportedRow, ImportedSet, open_imported
from phibench.calibration.captures.measure import (
    seen_images,
    seen_spots,
    shape_prior,
    widened_by_shape,
    with_blur_of,
)
from phibench.calibration.captures.spot_shape import SHAPE, UNLIKE, SpotPicture, SpotShape, fit_shape
from phibench.calibration.outline.outline import find_outline
from phibench.calibration.outline.outline_result import Outline, PoseMeasurement, mean_measured, outlines_as_one
from phibench.calibration.rig.bundle import Bundle, KnownSpot, calibrate
from phibench.calibration.rig.from_dataset import (
    OUTLINES,
    CalibrationSources,
    DatasetCalibration,
    Photograph,
    write_bundle,
)
from phibench.calibration.rig.vertical_edges import find_vertical
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import place_of
from phibench.datasets.store.files import require_writable
from phibench.estimator.geometry.least_squares_depth import depth_general
from phibench.estimator.geometry.rig_parameters import stroke_of
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import Pair
from phibench.estimator.methods.joint_fit import with_posteriors
from phibench.estimator.methods.registry import method_for
from phibench.estimator.methods.spot_search import SharedPair, joint_or_separate
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.rig import POSITIONS, Rig

_NEAR = 0.15  # of D, by which a spot may be off and still be the laser's, for blur and filters
_FAR_SIGMAS = 4.0  # of D, or of the gap of the rays, from what outline and ruler allow: another light was taken


def calibrate_imported(
    folder: Path, out: Path, samples: Sequence[str] = (), sources: CalibrationSources = OUTLINES
) -> DatasetCalibration:
    """Calibrate the rig of an imported set and write the file.

    Parameters
    ----------
    folder : Path
    out : Path
    samples : ids or numbers; by default the first, with `spots` all that have a measured D
    sources : CalibrationSources
        A sample is left out where no spot is found, or where what is found contradicts the tape or itself by more than
        outline and ruler allow. Vertical edges are those of the pictures that show three or more.

    Raises
    ------
    DatasetError
        If no picture shows the mirror's outline, none has vertical edges that are wanted, or no spot is left.
    """
    require_writable(out)
    imported = open_imported(folder)
    rows = _rows(imported, samples, sources.spots)
    images, outlines, names = _outlines(imported, rows, sources.outline_sigma_factor)
    upright = _vertical(images, outlines, imported.rig) if sources.vertical else None
    sigmas = sources.sigmas
    aligned = calibrate(imported.rig, outlines_as_one(outlines), (), upright, sigmas)
    # spots are looked for with the mirror where it is: a rig off by some pixels has other epipolar lines
    rig = with_blur_of(aligned.rig, outlines)
    known: dict[str, KnownSpot] = {}
    left_out: dict[str, str] = {}
    shape = SpotShape.prior(rig)
    if sources.spots:
        shape = _shape(imported, rows, rig, aligned, outlines)
        for sample_id in dict.fromkeys(row.sample_id for row in rows):
            try:
                own = [row for row in rows if row.sample_id == sample_id]
                spot = _known(imported, own, rig, shape)
                _require_sound(spot, aligned)
                known[sample_id] = spot
            except DatasetError as error:
                left_out[sample_id] = str(error)
        if not known:
            raise DatasetError(
                f"no spot of {folder} to calibrate with; of {next(iter(left_out))}: {next(iter(left_out.values()))}"
            )
    bundle = calibrate(imported.rig, outlines_as_one(outlines), list(known.values()), upright, sigmas)
    made_from: dict[str, Any] = {
        "dataset": imported.info.name,
        "samples": list(known) or sorted({row.sample_id for row in rows}),
        "left_out": left_out,
        "preset": imported.preset,
        "spots": bool(known),
        **({SHAPE: shape.document()} if shape.images else {}),
        "sphere_in_camera_m": [outline.sphere_in_camera_m.tolist() for outline in outlines],
        "sigma_m": [outline.sigma_m.tolist() for outline in outlines],
        "vertical_in_camera": None if upright is None else upright.value.tolist(),
        "spot_uv_px": [[spot.uv_down_px.tolist(), spot.uv_up_px.tolist()] for spot in known.values()],
        "spot_depth_m": [spot.depth_m for spot in known.values()],
    }
    return write_bundle(out, bundle, imported.rig, images, outlines, names, made_from, sigmas)


def _rows(imported: ImportedSet, samples: Sequence[str], spots: bool) -> list[ImportedRow]:
    ids = list(dict.fromkeys(row.sample_id for row in imported.rows))
    chosen = {ids[place_of(name, ids, imported.folder)] for name in samples}
    wanted = chosen or set(ids if spots else ids[:1])
    rows = [row for row in imported.rows if row.sample_id in wanted and not (spots and row.depth_m is None)]
    if not rows:
        raise DatasetError(f"no sample of {imported.folder} has a measured D: put depth_m into pairs.csv")
    return rows


def _outlines(
    imported: ImportedSet, rows: Sequence[ImportedRow], factor: float
) -> tuple[list[Photograph], list[Outline], list[str]]:
    """Outlines that were found: of one sample in both positions, of several in one position each, taking turns.

    Of frames with the laser off, where there are some. Camera and mirror move together: positions differ by the room.
    """
    images, outlines, names = [], [], []
    fault: ImageError | None = None
    firsts = [row for row in rows if row.draw == 0]
    for number, row in enumerate(firsts):
        pair = imported.pair(row)
        for position in POSITIONS if len(firsts) == 1 else (POSITIONS[number % 2],):
            image = Photograph(pair.images.get(f"{position}_off", pair.images[position]), imported.card)
            try:
                outlines.append(find_outline(image.pixels, imported.rig, image.card).widened(factor))
            except ImageError as error:
                fault = error
                continue
            images.append(image)
            names.append(f"{row.sample_id} {position}")
    if fault is not None and not outlines:
        raise fault
    return images, outlines, names


def _vertical(images: Sequence[Photograph], outlines: Sequence[Outline], nominal: Rig) -> PoseMeasurement:
    """Mean vertical of the pictures that show one, with the covariance of a single one.

    Pictures of one room show the same edges, whose own errors they share.

    Raises
    ------
    ImageError
        If no picture shows one.
    """
    verticals: list[PoseMeasurement] = []
    fault: ImageError | None = None
    for image, outline in zip(images, outlines, strict=True):
        try:
            verticals.append(find_vertical(image.pixels, outline.rig(nominal), image.card, outline.covariance_m2))
        except ImageError as error:
            fault = error
    if fault is not None and not verticals:
        raise fault
    mean = mean_measured(verticals)
    return replace(mean, covariance=mean.covariance * len(verticals))


def _shape(
    imported: ImportedSet, rows: Sequence[ImportedRow], rig: Rig, aligned: Bundle, outlines: Sequence[Outline]
) -> SpotShape:
    """Blur and filters of all spots that lie where the tape says: another light has another width and colour."""
    images: list[SpotPicture] = []
    for row in rows:
        stroke_m = float(stroke_of(np.array(row.stroke_m), aligned.values))
        pair = replace(imported.pair(row), rig=rig, stroke_m=stroke_m)
        seen = seen_images(pair)
        if len(seen) == len(POSITIONS) and row.depth_m is not None:
            found_m = float(depth_exact(rig, stroke_m, seen["down"].uv_px, seen["up"].uv_px).depth_m)
            if abs(found_m / row.depth_m - 1.0) < _NEAR:
                images.extend(seen.values())
    return fit_shape(images, shape_prior(rig, outlines))


def _known(imported: ImportedSet, rows: Sequence[ImportedRow], rig: Rig, shape: SpotShape) -> KnownSpot:
    """Spot of a sample, of all its frames, at the distance of the tape."""
    pair = SharedPair.of(replace(_pair(imported, rows), rig=shape.rig(rig)))
    answer = method_for(imported.card)(pair)
    for position in POSITIONS:
        spot = getattr(answer, position)
        if spot.uv_px is None or spot.covariance_px2 is None:
            why = spot.status if spot.uv_px is None else "a light is there, but no fit of it stays at its place"
            raise DatasetError(f"no spot {position}: {why}")
    spots = seen_spots(joint_or_separate(pair, answer, with_posteriors(pair, answer)))
    row = rows[0]
    if row.depth_m is None or row.depth_sigma_m is None:
        raise DatasetError("no measured D")
    images = seen_images(pair)
    down, up = (widened_by_shape(spots[name], images.get(name), shape) for name in POSITIONS)
    if max(down.unlike, up.unlike) >= UNLIKE:
        raise DatasetError("the light has not the shape of a spot: the beam meets an edge or grazes a surface")
    return KnownSpot(
        down.uv_px,
        up.uv_px,
        down.covariance_px2,
        up.covariance_px2,
        row.stroke_m,
        depth_m=row.depth_m,
        depth_sigma_m=row.depth_sigma_m,
    )


def _pair(imported: ImportedSet, rows: Sequence[ImportedRow]) -> Pair:
    """Pair of all frames of a sample; frames with the laser off that rows share count once."""
    pairs = [imported.pair(row) for row in rows]
    first = pairs[0]
    frames = {
        name: list({row.files[name]: pair.images[name] for row, pair in zip(rows, pairs, strict=True)}.values())
        for name in first.images
    }
    known = {"rig": first.rig, "stroke_m": first.stroke_m, "card": first.card, "beam": first.beam}
    return Pair.of_frames(first.number, frames, **known)


def _require_sound(spot: KnownSpot, aligned: Bundle) -> None:
    """Refuse a spot that another light was taken for."""
    stroke_m = float(stroke_of(np.array(spot.stroke_m), aligned.values))
    places = spot.uv_down_px, spot.uv_up_px, spot.covariance_down_px2, spot.covariance_up_px2
    depth = depth_general(aligned.rig, stroke_m, *places, aligned.covariance)
    off = abs(float(depth.depth_m) - spot.depth_m) / math.hypot(float(depth.sigma_m), spot.depth_sigma_m)
    if not (off < _FAR_SIGMAS and float(depth.chi2) < _FAR_SIGMAS**2):
        raise DatasetError(
            f"what was found is {float(depth.depth_m):.3f} m away, the tape says {spot.depth_m:.3f} m; gap of the rays "
            f"{math.sqrt(float(depth.chi2)):.1f} sigma"
        )
