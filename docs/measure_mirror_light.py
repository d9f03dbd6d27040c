"""Light in the mirror beside Mitsuba's path tracer, by part: `measure_mirror_light.py DIR SAMPLE`.

The view down is rendered from the sample's exported scene, `--samples` a pixel in each of `--runs`. Lamps are left out,
with a margin of the lens's blur; so is the mirror's edge. Prints, for the robot, the rest, and both, the share of our
light and Mitsuba's light less ours. The error is from the scatter of the runs.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.datasets.read import Sample, open_finished
from phibench.datasets.scene.scene_check import LoadedScene, light_layer
from phibench.datasets.scene.scene_export import in_exported_pixels
from phibench.scenes.random_streams import seed_32

POSITION = "down"


def parts(sample: Sample, margin: int) -> dict[str, NDArray[np.bool_]]:
    """Pixels of each part of the mirror's image, lamps left out, shape (H, W)."""
    ids = in_exported_pixels(sample.rig.camera, sample.truth(POSITION)["object_id"], order=0)
    shapes = (*sample.room.surfaces, *sample.room.furniture)
    lamps = [k for k, shape in enumerate(shapes) if np.any(np.array(getattr(shape, "radiance_w_m2_sr", 0.0)) > 0.0)]
    outline = sample.rig.outline_px()
    v, u = np.mgrid[: ids.shape[0], : ids.shape[1]]
    middle = outline.mean(axis=0)
    reach = float(np.linalg.norm(outline - middle, axis=1).min()) - margin
    near_lamps = ndimage.binary_dilation(np.isin(ids, lamps), iterations=margin)
    both = (np.hypot(u - middle[0], v - middle[1]) < reach) & (ids >= 0) & ~near_lamps
    robot = both & (ids >= len(shapes))
    return {"all but lamps": both, "robot": robot, "rest": both & ~robot}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", type=Path)
    parser.add_argument("sample")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--runs", type=int, default=2)
    asked = parser.parse_args()
    (sample,) = open_finished(asked.directory).chosen([asked.sample])
    ours = light_layer(sample, POSITION)
    sigma = sample.rig.camera.blur_sigma_px
    shown = parts(sample, int(np.ceil(4.0 * sigma)))
    v, u = np.nonzero(shown["all but lamps"])
    crop = (int(u.min()), int(v.min()), int(np.ptp(u)) + 1, int(np.ptp(v)) + 1)
    window = slice(crop[1], crop[1] + crop[3]), slice(crop[0], crop[0] + crop[2])
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        scene = LoadedScene(sample, POSITION, Path(folder))
        for run in range(asked.runs):
            image = scene.rendered("ambient", crop, asked.samples, seed_32("mirror light", run))
            runs.append(ndimage.gaussian_filter(image, (sigma, sigma, 0.0)))
    whole = ours[shown["all but lamps"]].sum()
    for name, mask in shown.items():
        level = ours[mask].sum()
        ratios = np.array([image[mask[window]].sum() / level - 1.0 for image in runs])
        error = ratios.std(ddof=1) / np.sqrt(len(ratios))
        print(f"{name:14s} {100 * level / whole:5.1f} % {100 * ratios.mean():+6.2f} % +- {100 * error:.2f} %")


if __name__ == "__main__":
    main()
