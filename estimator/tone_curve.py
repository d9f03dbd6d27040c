"""The sRGB curve (IEC 61966-2-1) as an estimator needs it: forwards, backwards, and of a noisy value."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.scenes.frames import Array

_KNEE, _SLOPE = 0.0031308, 12.92
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(9)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


def encoded(linear: Array) -> Array:
    """Values in [0, 1] of linear light, cut to [0, 1]; any shape."""
    x = np.clip(linear, 0.0, 1.0)
    return np.asarray(np.where(x <= _KNEE, _SLOPE * x, 1.055 * x ** (1.0 / 2.4) - 0.055))


def decoded(code: Array) -> Array:
    """Linear light of values in [0, 1]; any shape."""
    y = np.asarray(code, float)
    return np.asarray(np.where(y <= _SLOPE * _KNEE, y / _SLOPE, ((np.maximum(y, 0.0) + 0.055) / 1.055) ** 2.4))


def slope(linear: Array) -> Array:
    """Derivative of `encoded`, any shape; 0 outside [0, 1]."""
    x = np.asarray(linear, float)
    inside = (x >= 0.0) & (x <= 1.0)
    power = 1.055 / 2.4 * np.maximum(x, _KNEE) ** (1.0 / 2.4 - 1.0)
    return np.asarray(np.where(inside, np.where(x <= _KNEE, _SLOPE, power), 0.0))


@dataclass(frozen=True)
class NoisyCode:
    """Encoded value of a Gaussian, arrays of the shape of its mean.

    Attributes
    ----------
    mean : E f(x)
    by_mean : its derivative by the mean of x, E f'(x)
    by_sigma : its derivative by the standard deviation of x
    variance : of f(x)
    """

    mean: Array
    by_mean: Array
    by_sigma: Array
    variance: Array


def noisy(mean: Array, sigma: Array) -> NoisyCode:
    """Encoded value of linear light with a Gaussian error, by Gauss-Hermite quadrature with 9 nodes.

    Derivatives by Stein's lemma: E f' = E f z / s, d E f / ds = E f (z^2 - 1) / s, z the standardised error. Where the
    curve is cut within the error, at 0 and 1, the quadrature is good to some per cent of the error.

    Parameters
    ----------
    mean, sigma : arrays of the same shape, full scale 1; sigma above 0
    """
    f = encoded(mean[..., None] + sigma[..., None] * _NODES)
    first = f @ _WEIGHTS
    by_mean = f @ (_WEIGHTS * _NODES) / sigma
    by_sigma = f @ (_WEIGHTS * (_NODES**2 - 1.0)) / sigma
    return NoisyCode(first, by_mean, by_sigma, (f - first[..., None]) ** 2 @ _WEIGHTS)
