"""Fisher matrix of any output by its mean and covariance, drawn or in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from phibench.scenes.frames import Array

_DEPENDENT = 1e-11  # of the largest eigenvalue of a covariance: below this an output repeats others


def processed_fisher(slopes: ArrayLike, covariance: Array, draws: int = 0) -> Array:
    """Lower bound of the Fisher matrix of any output from its mean and covariance, shape (k, k).

    J >= (dm/dt)^T C^-1 (dm/dt): M. Stein, A. Mezghani, J. A. Nossek, IEEE Signal Process. Lett. 21, 796 (2014).
    What is left out is in the output's higher moments, so that the inverse is no bound for every method: it is that of
    methods that know the output by its mean and covariance. The truth lies between it and the raw pixels' bound.

    Parameters
    ----------
    slopes : shape (k, n), or (s, k, n)
        Derivatives of the mean output by k unknowns. With s >= 2 independent noisy estimates only products of different
        ones are averaged, so that their noise adds no information.
    covariance : shape (n, n)
        Outputs that never vary (a clipped or empty pixel) must not depend on the unknowns; they are left out.
    draws : int
        Number of draws behind `covariance`; 0 for a closed form. C^-1 of a sample is too large by
        (draws - 1) / (draws - n - 2) for Gaussian data, which is divided out: J. Hartlap, P. Simon, P. Schneider,
        A&A 464, 399 (2007).

    Raises
    ------
    ValueError
        If there are too few draws for n outputs.
    """
    D = np.asarray(slopes, float)
    D = D[None] if D.ndim == 2 else D
    varies = np.diagonal(covariance) > 0.0
    n = int(varies.sum())
    factor = hartlap_factor(n, draws) if draws else 1.0
    D = D[:, :, varies]
    # outputs that are sums of others (interpolated pixels before they are rounded) add nothing: pseudo-inverse
    inverse = np.linalg.pinv(covariance[np.ix_(varies, varies)], rcond=_DEPENDENT, hermitian=True)
    products = np.einsum("akn,nm,blm->abkl", D, inverse, D, optimize=True)
    apart = ~np.eye(len(D), dtype=bool) if len(D) > 1 else np.ones((1, 1), bool)
    mean = products[apart].mean(axis=0)
    return factor * 0.5 * (mean + mean.T)


def hartlap_factor(outputs: int, draws: int) -> float:
    """(draws - n - 2) / (draws - 1), by which the inverse of a sample covariance of n outputs is unbiased."""
    if draws < outputs + 3:
        raise ValueError(
            f"covariance of {outputs} outputs from {draws} draws: it has no inverse; {outputs + 3} draws are the least "
            f"that will do, {10 * outputs} are sound"
        )
    return (draws - outputs - 2.0) / (draws - 1.0)
