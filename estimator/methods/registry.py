"""The methods that come with phibench, by name. One entry adds one."""

from __future__ import annotations

from phibench.estimator.methods.built_in import BuiltIn
from phibench.estimator.methods.chain_fit import chain_fit
from phibench.estimator.methods.detect import detect
from phibench.estimator.methods.joint_fit import joint_fit
from phibench.estimator.methods.libraries import photutils_centroid_2dg, trackpy_refine
from phibench.estimator.methods.linear import PROCESSED, RAW
from phibench.estimator.methods.off_difference import off_difference
from phibench.estimator.methods.raw_maximum_likelihood import raw_maximum_likelihood
from phibench.estimator.methods.red_centroid import red_centroid
from phibench.estimator.methods.sight import each_spot, each_spot_twice
from phibench.estimator.methods.simple import at_the_red_peak, in_the_box

_ALL = (
    BuiltIn(
        "brightest_pixel",
        each_spot(in_the_box("brightest_pixel")),
        "pixel of the largest luma in the box",
        "the plainest there is",
    ),
    BuiltIn(
        "red_centroid",
        each_spot(red_centroid),
        "centroid of R - max(G, B) in linear light above 30 % of its peak",
        "what most laser-spot detectors do",
    ),
    BuiltIn(
        "laplacian_blob",
        each_spot(in_the_box("laplacian_blob")),
        "largest negative Laplacian of Gaussian of the luma in the box, refined by parabolas",
        "T. Lindeberg, Int. J. Comput. Vis. 30, 79 (1998), at one scale",
    ),
    BuiltIn(
        "windowed_centroid",
        each_spot(at_the_red_peak("windowed_centroid")),
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
        each_spot(off_difference),
        "centroid of the red light that the laser adds: on minus off in linear light",
        "background subtraction, as in most laser triangulation",
        needs_off=True,
    ),
    BuiltIn(
        "raw_maximum_likelihood",
        each_spot_twice(raw_maximum_likelihood),
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
        "both images as one point of the room: likelihood on raw pixels, chain_fit's positions combined on others",
        "docs/limits.md",
    ),
    BuiltIn(
        "detect",
        detect,
        "peak of a matched filter over the whole mirror, boxes or not, refined by parabolas",
        "estimator/detect.py",
    ),
    BuiltIn(
        "photutils_centroid_2dg",
        each_spot(photutils_centroid_2dg),
        "elliptical Gaussian on the redness, by photutils",
        "photutils.centroids.centroid_2dg",
        package="photutils",
    ),
    BuiltIn(
        "trackpy_refine",
        each_spot(trackpy_refine),
        "centre of mass of the redness, moved until it is central, by trackpy",
        "J. C. Crocker, D. G. Grier, J. Colloid Interface Sci. 179, 298 (1996); trackpy.refine_com",
        package="trackpy",
    ),
)

KNOWN: dict[str, BuiltIn] = {method.name: method for method in _ALL}
"""All of them, those whose package is missing included."""

METHODS: dict[str, BuiltIn] = {name: method for name, method in KNOWN.items() if method.installed}
"""Those that can run here."""
