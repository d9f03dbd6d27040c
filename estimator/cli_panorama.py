"""`phibench panorama`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

from phibench.estimator.cli_words import Whole


def panorama(
    directory: Path,
    *,
    out: Path,
    sample: str | None = None,
    position: Literal["down", "up"] = "down",
    by: Literal["model", "truth"] = "model",
    width: Whole = 1440,
    elevation_deg: tuple[float, float] = (-60.0, 30.0),
    preset: str = "layers",
    image: Path | None = None,
    distance_m: float | None = None,
) -> int:
    """Unroll a view of a data set: columns are azimuths, rows elevations of the rays that leave the mirror.

    The middle is the robot's front (world x), left of it its left (world y). A pixel is the direction of a ray, or a
    point at --distance-m: a sphere has no single viewpoint.

    Parameters
    ----------
    directory
        Folder of a data set.
    out
        PNG file to write.
    sample
        Id of a sample; the first one by default.
    position
        Which of its two views.
    by
        "model": closed form with the nominal rig. "truth": the truth layer of the true rig, no model of the mirror.
    width
        Columns for 360 degrees; rows are as far apart as columns are at the horizon.
    elevation_deg
        Lower and upper edge, degrees above the horizon.
    preset
        "layers" (noise-free), or the preset of a frame to draw: "srgb8", "mjpeg".
    image
        PNG or JPEG to unroll in place of the sample's frame, taken with the same rig.
    distance_m
        Of the scene from the mirror's centre; by default far away.
    """
    from phibench.datasets.errors import DatasetError
    from phibench.datasets.files import require_writable
    from phibench.datasets.preview import save_png
    from phibench.datasets.read import open_finished
    from phibench.estimator.panorama import FAR_M, Grid
    from phibench.estimator.panorama_picture import panorama as unroll
    from phibench.estimator.panorama_picture import picture_of

    grid = Grid(width, *(math.radians(each) for each in elevation_deg))
    dataset = open_finished(directory)
    if not dataset.samples:
        raise DatasetError(f"{directory} has no samples to unroll")
    chosen = dataset.samples[0] if sample is None else dataset[sample]
    require_writable(out)
    distance = FAR_M if distance_m is None else distance_m
    result = unroll(chosen, position, grid, by, distance, picture_of(chosen, position, preset, image))
    save_png(out, result.pixels)
    print(
        f"{out}: {grid.width_px} x {grid.height_px} pixels of {360.0 / grid.width_px:g} degrees, "
        f"{chosen.row.sample_id} {position}, by {by}; {100.0 * result.seen:.1f} % of it is in the image"
    )
    return 0
