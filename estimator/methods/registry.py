"""All built-in methods that find the spot, by name; code of the simple, the learned and other packages' ones.

To add a method, add one entry to `_ALL`. `KNOWN` holds all of them, `METHODS` those that are installed. Extractors of
`simple_spots` work on the picture as a viewer shows it. They and those of other packages are rows to compare with; each
package is imported when its method runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.interface import Answer, Box, Method, Pair, Spot
from phibench.estimator.learned.network_graphs import CROP, DETECT
from phibench.estimator.learned.network_input import ACCEPTED, frame_input
from phibench.estimator.learned.networks import Network, heat_peaks, network, refined_position, shipped_network
from phibench.estimator.methods.chain_fit import chain_fit
from phibench.estimator.methods.joint_fit import joint_fit
from phibench.estimator.methods.raw_likelihood import raw_likelihood
from phibench.estimator.methods.spot_search import (
    SearchRegion,
    at_detection,
    each_spot,
    pair_detection,
    red_peak,
    spot_of,
)
from phibench.estimator.spots.candidates import Candidates
from phibench.estimator.spots.detect import Detection, Thresholds, choose, mirror_box, outline_mask
from phibench.estimator.spots.image_planes import KINDS, PROCESSED, RAW, kind_of, linear_planes, redness
from phibench.estimator.spots.simple_spots import SIMPLE_METHODS, thresholded_centroid
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import POSITIONS

# Built-in methods that learned: a network on the crop where `detect` sees the spot, and one that finds it by itself.
#
# The networks come with phibench, or from files: `estimator.learned` has their inputs, files and training.


def _named(name: str, file: Path | None) -> Network:
    return shipped_network(name) if file is None else network(file, name)


def learned_crop(file: Path | None = None) -> Method:
    """Network of a file on the 32 x 32 pixels about the spot's place; by default the network that phibench ships.

    Examples
    --------
    >>> from pathlib import Path
    >>> from phibench.estimator.methods.registry import learned_crop
    >>> extract = learned_crop(Path("my_crop.onnx"))  # in my_phi.py: phibench score ... --method my_phi.py:extract
    """
    if file is not None:
        network(file, CROP)  # a wrong file is refused before the first pair

    def find(region: SearchRegion) -> Spot:
        peak = region.place
        if peak is None:
            return Spot.missing("no spot")
        u0, v0 = region.origin_px
        pair, name = region.pair, region.position
        place = (peak[0] + u0, peak[1] + v0)
        images = pair.images[name], pair.images.get(f"{name}_off")
        spot = refined_position(_named(CROP, file), *images, pair.card, _response(pair), place)
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
    for name, file in ((DETECT, detector), (CROP, crop)):
        if file is not None:
            network(file, name)

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
    images = pair.images[position], pair.images[f"{position}_off"]
    return refined_position(crop, *images, pair.card, _response(pair), (u, v), scale)


def _response(pair: Pair) -> tuple[float, ...]:
    return pair.rig.camera.detector.laser_filter_response


Finder = Callable[[SearchRegion], Spot]


def in_the_box(name: str) -> Finder:
    """Simple extractor on the whole box, whatever is brightest there.

    Parameters
    ----------
    name : key of `simple_spots.SIMPLE_METHODS`
    """

    def find(region: SearchRegion) -> Spot:
        return spot_of(SIMPLE_METHODS[name](region.picture[None], region.origin_px))

    return find


def at_the_red_peak(name: str) -> Finder:
    """Simple extractor on 15 x 15 pixels about the spot's place (`SearchRegion.place`).

    Parameters
    ----------
    name : key of `simple_spots.SIMPLE_METHODS`
    """

    def find(region: SearchRegion) -> Spot:
        near = region.narrowed()
        return Spot.missing("no spot") if near is None else in_the_box(name)(near)

    return find


def red_centroid(region: SearchRegion) -> Spot:
    """Thresholded centroid of the redness about the spot's place; of the signal without colour filters."""
    near = region.narrowed()
    if near is None:
        return Spot.missing("no spot")
    return spot_of(thresholded_centroid(redness(near.planes)[None], near.origin_px))


def off_difference(region: SearchRegion) -> Spot:
    """Thresholded centroid of the difference's red plane, on 15 x 15 pixels about the spot's place."""
    near = region.window_at(red_peak(_added(region)) if region.found is None else region.place)
    if near is None:
        return Spot.missing("no spot in the difference")
    return spot_of(thresholded_centroid(_added(near)[None], near.origin_px))


def _added(region: SearchRegion) -> Array:
    """Red plane of on - off, shape (h, w); differences of encoded values would depend on the room's level."""
    off = region.off_pixels
    if off is None:
        raise ValueError("off_difference: the pair has no laser-off frames")
    return region.planes[0] - linear_planes(off, region.pair.card, region.origin_px)[0]


TRACKPY_DIAMETER_PX = 7  # odd, as trackpy asks


def photutils_centroid_2dg(region: SearchRegion) -> Spot:
    """`photutils.centroids.centroid_2dg` on `_laser_in` of 15 x 15 pixels: an elliptical Gaussian by least squares."""
    from photutils.centroids import centroid_2dg

    near = region.narrowed()
    if near is None:
        return Spot.missing("no spot")
    u, v = (float(x) for x in centroid_2dg(_above(near)))
    return _spot_in_window(near, u, v)


def trackpy_refine(region: SearchRegion) -> Spot:
    """`trackpy.refine_com` on `_laser_in` of 15 x 15 pixels: centroid in a disc of 7 pixels, moved until it is central.

    Trackpy's own search wants whole numbers; the start is the red peak.
    """
    from trackpy import refine_com

    near = region.narrowed()
    if near is None:
        return Spot.missing("no spot")
    image = np.maximum(_above(near), 0.0)
    middle = np.array([[image.shape[0] // 2, image.shape[1] // 2]])
    table = refine_com(image, image, TRACKPY_DIAMETER_PX // 2, middle, pos_columns=["v", "u"], engine="python")
    return _spot_in_window(near, float(table["u"].iloc[0]), float(table["v"].iloc[0]))


def _above(near: SearchRegion) -> Array:
    """Laser's light over the median of the window's border; scaled, because a fit's tolerances are absolute."""
    red = _laser_in(near)
    edge = np.concatenate([red[0], red[-1], red[1:-1, 0], red[1:-1, -1]])
    above = red - np.median(edge)
    return np.asarray(above / max(float(above.max()), 1e-12))  # nothing above the border stays 0


def _laser_in(near: SearchRegion) -> Array:
    """Red plane of on - off; the redness where there is no laser-off frame."""
    return redness(near.planes) if near.off_pixels is None else _added(near)


def _spot_in_window(near: SearchRegion, u: float, v: float) -> Spot:
    """Answer for a position in the window."""
    if not (0.0 <= u <= near.box.width_px - 1.0 and 0.0 <= v <= near.box.height_px - 1.0):
        return Spot.missing("spot cut")
    return Spot((u + near.box.u0_px, v + near.box.v0_px))


def detected_spots(pair: Pair) -> Answer:
    """Position of the matched filter's peak, refined by a parabola, in both images."""
    detections = pair_detection(pair)
    return Answer(_detected_spot(detections.down), _detected_spot(detections.up))


def _detected_spot(found: Detection | None) -> Spot:
    return Spot.missing("no spot found") if found is None else Spot(found.uv_px)


# -- methods of one function -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BuiltIn:
    """One built-in method; call it like any method. A pair that it cannot take gets a status, never an exception.

    Parameters
    ----------
    description : str
        One line.
    source : str
        Where the idea comes from.
    accepts : tuple of str
        Kinds of images, of `image_planes.KINDS`.
    needs_off : bool
        It cannot do without laser-off frames.
    needs_boxes : bool
        It cannot do without region hints.
    package : str
        What must be installed besides phibench; "" for nothing.
    joint : bool
        It takes both spots as one point of the room: its efficiency is against the pair's bound, not each image's.
    """

    name: str
    function: Method
    description: str
    source: str
    accepts: tuple[str, ...] = KINDS
    needs_off: bool = False
    needs_boxes: bool = False
    package: str = ""
    joint: bool = False

    @property
    def installed(self) -> bool:
        """Its package can be imported."""
        return not self.package or find_spec(self.package) is not None

    @property
    def needs(self) -> str:
        """Package to install where it is missing, in words."""
        return f"needs {self.package}: pip install {self.package}"

    def refusal(self, pair: Pair) -> str:
        """Reason that this pair cannot be taken; "" if it can."""
        kind = kind_of(pair.card)
        if not self.installed:
            return f"install {self.package}"
        if kind not in self.accepts:
            return f"takes {', '.join(self.accepts)}, not {kind}"
        if self.needs_off and (pair.down_off is None or pair.up_off is None):
            return "needs laser-off frames"
        if self.needs_boxes and (pair.box_down is None or pair.box_up is None):
            return "needs region hints"
        return ""

    def __call__(self, pair: Pair) -> Answer:
        """Answer for a pair, or a status that says why there is none."""
        why = self.refusal(pair)
        return Answer(Spot.missing(why), Spot.missing(why)) if why else self.function(pair)


REFUSED = ("takes ", "needs ")
"""Beginnings of `BuiltIn.refusal` where a method that is installed cannot take a pair."""

_ALL = (
    BuiltIn(
        "brightest_pixel",
        each_spot(in_the_box("brightest_pixel"), hints=True),
        "pixel of the largest luma in the box",
        "the plainest there is",
    ),
    BuiltIn(
        "red_centroid",
        each_spot(red_centroid, hints=True),
        "centroid of R - max(G, B) in linear light above 30 % of its peak",
        "what most laser-spot detectors do",
    ),
    BuiltIn(
        "laplacian_blob",
        each_spot(in_the_box("laplacian_blob"), hints=True),
        "largest negative Laplacian of Gaussian of the luma in the box, refined by parabolas",
        "T. Lindeberg, Int. J. Comput. Vis. 30, 79 (1998), at one scale",
    ),
    BuiltIn(
        "windowed_centroid",
        each_spot(at_the_red_peak("windowed_centroid"), hints=True),
        "centroid of the luma under a Gaussian window that follows it",
        "E. Bertin, S. Arnouts, A&AS 117, 393 (1996)",
    ),
    BuiltIn(
        "gaussian_least_squares",
        each_spot(at_the_red_peak("gaussian_least_squares")),
        "least squares of a round Gaussian and a constant on the luma",
        "scipy.optimize.least_squares",
    ),
    BuiltIn(
        "off_difference",
        each_spot(off_difference, hints=True),
        "centroid of the red light that the laser adds: on minus off in linear light",
        "background subtraction, as in most laser triangulation",
        needs_off=True,
    ),
    BuiltIn(
        "raw_maximum_likelihood",
        raw_likelihood,
        "maximum likelihood on raw pixels with the sensor's noise; claims a covariance",
        "F. Huang et al., Nature Methods 10, 653 (2013)",
        accepts=RAW,
    ),
    BuiltIn(
        "chain_fit",
        chain_fit,
        "fit of the spot through mosaic, demosaicing, gamma, 8 bits and JPEG; claims a covariance",
        "docs/limits.md",
        accepts=PROCESSED,
    ),
    BuiltIn(
        "joint_fit",
        joint_fit,
        "both images as one point of the room: likelihood on raw pixels, mean of the posterior on others",
        "docs/limits.md",
        joint=True,
    ),
    BuiltIn(
        "detect",
        detected_spots,
        "peak of a matched filter over the whole mirror, boxes or not, refined by parabolas",
        "estimator/spots/detect.py",
    ),
    BuiltIn(
        "learned_crop",
        learned_crop(),
        "small network on the 32 x 32 pixels about the spot that `detect` sees; claims a covariance",
        "docs/learned.md",
        accepts=ACCEPTED,
        package="onnxruntime",
    ),
    BuiltIn(
        "learned_detect",
        learned_detect(),
        "small network that finds the spot in the whole mirror, then that of `learned_crop`; claims a covariance",
        "docs/learned.md",
        accepts=ACCEPTED,
        needs_off=True,
        package="onnxruntime",
    ),
    BuiltIn(
        "photutils_centroid_2dg",
        each_spot(photutils_centroid_2dg),
        "elliptical Gaussian on the red light of on - off, by photutils; on the redness without a laser-off frame",
        "photutils.centroids.centroid_2dg",
        package="photutils",
    ),
    BuiltIn(
        "trackpy_refine",
        each_spot(trackpy_refine, hints=True),
        "centre of mass of the same light, moved until it is central, by trackpy",
        "J. C. Crocker, D. G. Grier, J. Colloid Interface Sci. 179, 298 (1996); trackpy.refine_com",
        package="trackpy",
    ),
)

KNOWN: dict[str, BuiltIn] = {method.name: method for method in _ALL}
"""All of them, those whose package is missing included."""

METHODS: dict[str, BuiltIn] = {name: method for name, method in KNOWN.items() if method.installed}
"""Those that can run here."""


def method_for(card: SensorCard) -> BuiltIn:
    """The built-in method that comes closest to the bound of this kind of image and claims a covariance."""
    return METHODS["raw_maximum_likelihood" if kind_of(card) in RAW else "chain_fit"]
