"""Bounds of pairs: joint covariances of both images, smallest possible ones, and squared errors over these."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.benchmark.scores.answer_errors import phi_variance, with_kept_results
from phibench.benchmark.scores.beyond_images import clipped_covariances, least_px2, squares
from phibench.estimator.geometry.least_squares_depth import JointBound, information, joint_bound
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig


@dataclass(frozen=True)
class PairBounds:
    """Joint bounds of n pairs that share a nominal rig, and what their answers make of them; NaN where there is none.

    Attributes
    ----------
    down_px2, up_px2 : shape (n, 2, 2), of (u, v)
    depth_m2 : shape (n,)
    possible_position_chi2 : shape (n,)
        Squared errors over what is possible, of 3 degrees of freedom.
    possible_spot_px2, possible_spot_chi2, possible_spot_phi_rad2 : (down, up), shape (n,) each
        Of each image: trace of the smallest possible covariance, squared errors over it, of 2 degrees of freedom, and
        smallest possible variance of phi.
    possible_depth_m2 : shape (n,)
        Smallest possible variance of D.
    """

    down_px2: Array
    up_px2: Array
    depth_m2: Array
    possible_position_chi2: Array
    possible_spot_px2: tuple[Array, Array]
    possible_spot_chi2: tuple[Array, Array]
    possible_spot_phi_rad2: tuple[Array, Array]
    possible_depth_m2: Array


@dataclass(frozen=True)
class SpotBoundsOfImages:
    """Both bounds of the single images of n pairs, shape (n, 2, 2): of the image, and of the raw pixels behind it."""

    image_px2: Array
    raw_px2: Array


def pair_bounds(
    rig: Rig,
    stroke_m: Array,
    depth_m: Array,
    true_px: tuple[Array, Array],
    bounds: tuple[SpotBoundsOfImages, SpotBoundsOfImages],
    errors_px: tuple[Array, Array],
) -> PairBounds:
    """Joint bounds of pairs, and their squared errors over what is possible.

    Parameters
    ----------
    rig : Rig, the nominal one
    stroke_m, depth_m : shape (n,)
    true_px, errors_px : (down, up), shape (n, 2) each
    bounds : (down, up)
    """
    at = rig, stroke_m, true_px[0], depth_m
    joint = _joint_bound(*at, *(bound.image_px2 for bound in bounds))
    possible_px2 = [least_px2(bound.image_px2, bound.raw_px2) for bound in bounds]
    possible = _joint_bound(*at, *possible_px2)
    of_both = possible.covariance_down_px2, possible.covariance_up_px2
    least = [clipped_covariances(_or(C, alone)) for C, alone in zip(of_both, possible_px2, strict=True)]
    down, up = (
        (np.trace(V, axis1=1, axis2=2), squares(e, V), phi_variance(rig, uv, V))
        for uv, e, V in zip(true_px, errors_px, least, strict=True)
    )
    return PairBounds(
        joint.covariance_down_px2,
        joint.covariance_up_px2,
        joint.variance_depth_m2,
        _projected(possible, possible_px2, errors_px),
        (down[0], up[0]),
        (down[1], up[1]),
        (down[2], up[2]),
        possible.variance_depth_m2,
    )


def _or(covariance_px2: Array, alone_px2: Array) -> Array:
    """Covariances of both images together, those of single images where there is none."""
    joint = np.asarray(np.isfinite(covariance_px2).all(axis=(1, 2)))
    return np.where(joint[:, None, None], covariance_px2, alone_px2)


_joint_bound = with_kept_results(joint_bound)


def _projected(joint: JointBound, covariances_px2: list[Array], errors_px: tuple[Array, Array]) -> Array:
    """b^T A^-1 b, b the information-weighted errors: chi^2 of three degrees, shape (n,)."""
    W1, W2 = (information(C) for C in covariances_px2)
    b = np.einsum("nji,njk,nk->ni", joint.jacobian, W2, errors_px[1])
    b[:, :2] += np.einsum("nij,nj->ni", W1, errors_px[0])
    with np.errstate(invalid="ignore"):
        good = np.isfinite(joint.information).all(axis=(1, 2)) & np.isfinite(b).all(axis=1)
    A = np.where(good[:, None, None], joint.information, np.eye(3))
    solved = np.linalg.solve(A, np.where(good[:, None], b, 0.0)[..., None])[..., 0]
    return np.where(good, np.einsum("ni,ni->n", b, solved), np.nan)
