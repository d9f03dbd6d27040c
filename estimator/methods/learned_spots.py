"""Built-in methods that learned: a network on the crop where `detect` sees the spot, and one that finds it by itself.

The networks come with phibench, or from files: `estimator.learned` has their inputs, files and training.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from phibench.estimator.interface import Answer, Box, Method, Pair, Spot
from phibench.estimator.learned.network_input import frame_input
from phibench.estimator.learned.networks import CROP, DETECT, Network, heat_peaks, network, refined, shipped
from phibench.estimator.methods.locate import SearchRegion, at_detection, each_spot
from phibench.estimator.spots.candidates import Candidates
from phibench.estimator.spots.detect import Thresholds, choose, mirror_box, outline_mask
from phibench.estimator.spots.image_planes import kind_of
from phibench.scenes.frames import BoolArray
from phibench.scenes.rig import POSITIONS


def _named(name: str, file: Path | None) -> Network:
    return shipped(name) if file is None else network(file, name)


def learned_crop(file: Path | None = None) -> Method:
    """Network of a file on the 32 x 32 pixels about the spot's place; by default the network that phibench ships.

    Examples
    --------
    >>> from pathlib import Path
    >>> from phibench.estimator.methods.learned_spots import learned_crop
    >>> extract = learned_crop(Path("my_crop.onnx"))  # in my_phi.py: phibench score ... --method my_phi.py:extract
    """

    def find(region: SearchRegion) -> Spot:
        peak = region.place
        if peak is None:
            return Spot.missing("no spot")
        u0, v0 = region.origin_px
        pair, name = region.pair, region.position
        place = (peak[0] + u0, peak[1] + v0)
        crop = _named(CROP, file)
        spot = refined(crop, pair.images[name], pair.images.get(f"{name}_off"), pair.card, place)
        return at_detection(region.found, spot)

    return each_spot(find)


def learned_detect(detector: Path | None = None, crop: Path | None = None) -> Method:
    """Network on the whole mirror, then the network of crops at the place that it found.

    Peaks of its heat in both images are chosen as `detect` chooses: by the light of a consistent pair, or alone. The
    covariance has a scale of its own, from spots that this network found.

    Parameters
    ----------
    detector, crop : Path, optional
        Files of the networks; by default those that phibench ships.
    """

    def method(pair: Pair) -> Answer:
        finder = _named(DETECT, detector)
        alone, each = finder.thresholds(kind_of(pair.card))
        # a box is a hundredth of the mirror: as many false peaks of the lower threshold as of the higher one elsewhere
        least = Thresholds(each if pair.box_down is not None and pair.box_up is not None else alone, each, each)
        down, up = (_candidates(finder, pair, position, each) for position in POSITIONS)
        choice = choose(pair.rig, pair.stroke_m, down, up, least, sure=True)
        found = _named(CROP, crop), finder.scale
        first = _spot(*found, pair, "down", down, choice.down)
        return Answer(first, _spot(*found, pair, "up", up, choice.up))

    return method


def _candidates(finder: Network, pair: Pair, position: str, least: float) -> Candidates:
    """Peaks of the heat inside the outline, in the image, those with the most light first."""
    box = mirror_box(pair.rig)
    box = Box(box.u0_px, box.v0_px, box.width_px // 2 * 2, box.height_px // 2 * 2)
    on, off = (pair.images[name][box.slices] for name in (position, f"{position}_off"))
    planes, red = frame_input(on, off, pair.card)
    heat = np.asarray(finder.run(planes=planes[None])[0][0, 0], float)
    peaks = heat_peaks(heat, red, _searched(pair, position, box)[::2, ::2], least)
    order = np.argsort(-peaks.red_e, kind="stable")
    uv = 2.0 * peaks.cells[order] + 0.5 + [box.u0_px, box.v0_px]
    nothing = np.zeros(len(order))
    return Candidates(uv, peaks.heat[order], peaks.red_e[order], nothing, nothing, np.ones(len(order), bool))


def _searched(pair: Pair, position: str, box: Box) -> BoolArray:
    """Pixels of a box inside the outline, and in the hint where there is one."""
    inside, hint = outline_mask(pair.rig, box), getattr(pair, f"box_{position}")
    if hint is not None:
        v, u = np.indices(inside.shape)
        u, v = u + box.u0_px - hint.u0_px, v + box.v0_px - hint.v0_px
        inside = inside & (u >= 0) & (u < hint.width_px) & (v >= 0) & (v < hint.height_px)
    return np.asarray(inside, bool)


def _spot(crop: Network, scale: float, pair: Pair, position: str, found: Candidates, row: int | None) -> Spot:
    if row is None:
        return Spot.missing("no spot found")
    u, v = (float(x) for x in found.uv_px[row])
    return refined(crop, pair.images[position], pair.images[f"{position}_off"], pair.card, (u, v), scale)
