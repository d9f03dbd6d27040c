"""Lens blur and colour response fitted to laser spots; their part in a spot's covariance; how unlike a spot a light is.

Nobody measures either with a ruler, and a fit of the position takes both as known. Where they are wrong, bright spots
are off by some of their sigmas: a blur of 0.70 instead of 0.85 px made the rms of D 1.7 times as large, and the pull
2.4. So they are fitted to the spots themselves, with a prior. Of each spot position, flux and levels are free, and what
is left of the score by blur and filters counts (profile likelihood). All pictures of a rig are fitted together.

What is left uncertain moves the positions by -A^-1 B d(shape): A is the Fisher matrix of the spot's own unknowns, B
that between them and the shape. `seen_through` gives what this adds to a position's covariance.

It also says how unlike a spot the light is: the rms of what the model leaves, over that of the spot's light, both over
their noise. A beam that is torn by an edge or that grazes a surface is 0.9 to 1.9 off, a blur that is wrong by a tenth
0.1. No position of such a light is the beam's, and no covariance of its fit holds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from phibench.calibration.rig.calibration_file import Calibration
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.status import Status
from phibench.estimator.interface import Answer, Pair, Spot
from phibench.estimator.methods.chain_fit import spot_outputs
from phibench.estimator.methods.raw_likelihood import raw_spot_data
from phibench.estimator.methods.spot_search import pair_blur, seen_depth_m
from phibench.estimator.processed.quasi_score import CoefficientWindow, fit_window
from phibench.estimator.spots.fit_raw import SpotData, fit_law
from phibench.estimator.spots.gaussian_spot import SpotModel, SpotPixels, limited_step
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS, Rig

SHAPE = "spot_shape"
"""Key of a `SpotShape` in what a calibration was made from."""
PRIOR_SIGMA = (0.25, 0.06, 0.04)
"""Of the blur in pixels, and of green's and blue's response over red's, of a camera that nobody has measured."""
OUTLINE_SIGMA_PX = 0.1  # of a blur that the mirror's outline gave
_STEP = (0.02, 0.01, 0.01)  # of differences
_LONGEST = (0.12, 0.04, 0.04)  # of one step: blur in pixels, shares of green and blue
_LOW, _HIGH = (0.2, 0.0, 0.0), (5.0, 1.0, 1.0)
_ROUNDS, _REST = 6, 0.1  # steps of the fit, and the step in standard deviations at which it ends
_FIELD = (0.02, 0.01, 0.01)
"""Rms by which blur and responses differ from spot to spot: field of a lens, profile of a beam, loss of chroma."""
_OUTLIER = 3.0  # of a residual in standard deviations
_MOST_EXCESS = 6.0  # of the misfit per degree of freedom: what is there is not one spot alone
UNLIKE = 0.5
"""Share of a light that a spot leaves unexplained, from which on it is none; half of what was seen of torn beams."""
_UNLIKE_SIGMAS = 6.0  # of the misfit, below which its share is noise
_ROOM_EXCESS = (
    2.0  # of the misfit per degree of freedom that steps of a JPEG leave of a room full of edges; 1.8 was seen
)


@dataclass(frozen=True)
class SpotShape:
    """Blur of the lens, pixels, and the response of green and blue at the laser's line over red's.

    Attributes
    ----------
    values : shape (3,)
    covariance : shape (3, 3)
    images : int
        Pictures of spots that it was fitted to; 0 for a prior.
    """

    values: Array
    covariance: Array = field(repr=False)
    images: int = 0

    @classmethod
    def prior(cls, rig: Rig, blur_sigma_px: float = PRIOR_SIGMA[0]) -> SpotShape:
        """Shape that a rig's numbers say, with the uncertainty of numbers that nobody has measured."""
        response = rig.camera.detector.laser_filter_response
        values = np.array([rig.camera.blur_sigma_px, response[1] / response[0], response[2] / response[0]])
        return cls(values, np.diag([blur_sigma_px, *PRIOR_SIGMA[1:]]) ** 2)

    @classmethod
    def of_document(cls, document: Any) -> SpotShape:
        """Shape of a calibration file.

        Raises
        ------
        DatasetError
            If it is none.
        """
        try:
            values, covariance = (np.array(document[name], float) for name in ("values", "covariance"))
            sound = values.shape == (3,) and covariance.shape == (3, 3) and np.linalg.eigvalsh(covariance).min() >= 0.0
            if sound and (values >= _LOW).all() and (values <= _HIGH).all():
                return cls(values, covariance, int(document["images"]))
        except (KeyError, TypeError, ValueError, np.linalg.LinAlgError):
            pass
        raise DatasetError("the calibration's spot_shape is no blur with two responses: make it again")

    def document(self) -> dict[str, Any]:
        """JSON of it, for a calibration file."""
        return {"values": self.values.tolist(), "covariance": self.covariance.tolist(), "images": self.images}

    @property
    def sigmas(self) -> Array:
        """Standard deviations, shape (3,)."""
        return np.sqrt(np.diag(self.covariance))

    def rig(self, rig: Rig) -> Rig:
        """The rig with this blur and these filters."""
        camera, (blur, green, blue) = rig.camera, self.values.tolist()
        red = camera.detector.laser_filter_response[0]
        detector = replace(camera.detector, laser_filter_response=(red, red * green, red * blue))
        return replace(rig, camera=replace(camera, blur_sigma_px=blur, detector=detector))


@dataclass(frozen=True)
class SpotPicture:
    """One picture of a spot near (u, v), with the distance, if it is known."""

    pair: Pair
    position: str
    uv_px: Array
    depth_m: float | None


def with_shape(calibration: Calibration) -> Calibration:
    """Calibration whose rig has the blur and filters that its file holds; the same where it holds none."""
    document = calibration.made_from.get(SHAPE)
    if document is None:
        return calibration
    return replace(calibration, rig=SpotShape.of_document(document).rig(calibration.rig))


def spot_pictures(pair: Pair, down: Spot, up: Spot) -> dict[str, SpotPicture]:
    """Pictures of a pair, by position, in which a spot was seen."""
    depth_m = seen_depth_m(pair, Answer(down, up))
    return {
        name: SpotPicture(pair, name, np.array(spot.uv_px), depth_m)
        for name, spot in zip(POSITIONS, (down, up), strict=True)
        if spot.uv_px is not None
    }


def fit_shape(images: Sequence[SpotPicture], prior: SpotShape) -> SpotShape:
    """Shape of all these spots together; the prior where none of them can be fitted."""
    values, weight = prior.values, np.linalg.inv(prior.covariance)
    outputs = [_outputs(image) for image in images]
    thetas: list[Array | None] = [None] * len(images)
    for _ in range(_ROUNDS):
        found = [
            _linear(*one, values, theta) for one, theta in zip(zip(images, outputs, strict=True), thetas, strict=True)
        ]
        scores, informations = _together([window_fit for window_fit in found if window_fit is not None])
        if not len(scores):
            return prior
        normal = weight + informations.sum(axis=0)
        step = np.linalg.solve(normal, weight @ (prior.values - values) + scores.sum(axis=0))
        new = np.clip(values + np.clip(step, -np.array(_LONGEST), _LONGEST), _LOW, _HIGH)
        thetas = [None if window_fit is None else window_fit.advanced(new - values) for window_fit in found]
        small, values = np.sqrt(step @ normal @ step) < _REST, new
        if small:
            break
    covariance = np.linalg.inv(normal) * _scatter(scores, informations)
    return SpotShape(values, covariance + np.diag(_FIELD) ** 2, len(scores))


def seen_through(image: SpotPicture, shape: SpotShape) -> tuple[Array, float]:
    """Part of a place's covariance that the shape adds, shape (2, 2), square pixels; share of the light that is unlike.

    The part is 0 where the light is no spot alone, the share where it is noise.
    """
    part = _any_linear(image, _outputs(image), shape.values, None)
    if part is None:
        return np.zeros((2, 2)), 0.0
    covariance = part.moved @ shape.covariance @ part.moved.T if part.sound else np.zeros((2, 2))
    return np.asarray(covariance), part.unlike


# -- one picture -----------------------------------------------------------------------------------------------------

_Outputs = SpotData | tuple[CoefficientWindow, Array, Array]


@dataclass(frozen=True)
class _Linear:
    """One picture about a shape and a hypothesis theta, shape (k,).

    Attributes
    ----------
    A, B, C : arrays, Fisher matrices of the spot's own unknowns (k, k), with the shape (k, 3), of the shape (3, 3)
    g, h : scores, shapes (k,) and (3,)
    excess : float
        Misfit per degree of freedom where it is above 1.
    unlike : float
        Share of the light that the spot leaves unexplained; 0 where it is noise.
    """

    theta: Array
    A: Array
    B: Array
    C: Array
    g: Array
    h: Array
    excess: float
    unlike: float

    @property
    def sound(self) -> bool:
        """True where one spot alone is there."""
        return bool(self.excess < _MOST_EXCESS and np.linalg.cond(self.A) < 1e15)

    @property
    def moved(self) -> Array:
        """Derivative of the place by the shape, shape (2, 3)."""
        return np.asarray(-np.linalg.solve(self.A, self.B)[:2])

    def profiled(self) -> tuple[Array, Array]:
        """Score (3,) and information (3, 3) about the shape with the own unknowns at their best, over the misfit."""
        own = np.linalg.solve(self.A, np.column_stack([self.B, self.g]))
        return (self.h - self.B.T @ own[:, 3]) / self.excess, (self.C - self.B.T @ own[:, :3]) / self.excess

    def advanced(self, step: Array) -> Array:
        """Hypothesis that belongs to a changed shape."""
        own: Array = np.asarray(np.linalg.solve(self.A, self.g - self.B @ step), float)
        return limited_step(self.theta[None], own[None])[0]


def _outputs(image: SpotPicture) -> _Outputs:
    outputs = raw_spot_data if image.pair.card.output == "raw" else spot_outputs
    return outputs(image.pair, image.position, image.uv_px, image.depth_m)


def _linear(image: SpotPicture, outputs: _Outputs, values: Array, theta: Array | None) -> _Linear | None:
    """Linear model of one picture; None where it has no fit, or what is there is no spot alone."""
    found = _any_linear(image, outputs, values, theta)
    return found if found is not None and found.sound else None


def _any_linear(image: SpotPicture, outputs: _Outputs, values: Array, theta: Array | None) -> _Linear | None:
    if isinstance(outputs, SpotData):
        return _of_data(image, outputs, values)
    return _of_window(image, outputs[0], outputs[1], values, theta)


def _unlike(squares: float, freedom: int, light2: float) -> float:
    """Share of a light, whose square over the noise is `light2`, that squares of residuals over the noise leave."""
    left = squares - freedom
    return math.sqrt(left / light2) if left > _UNLIKE_SIGMAS * math.sqrt(2.0 * freedom) and light2 > 0.0 else 0.0


def _of_window(
    image: SpotPicture, window: CoefficientWindow, start: Array, values: Array, theta: Array | None
) -> _Linear | None:
    filters = window.model.filters[None]

    def at(shape: Array) -> CoefficientWindow:
        pixels = replace(_pixels(image, shape, filters, None), background_e=window.pixels.background_e)
        return replace(window, pixels=pixels)

    here = at(values)
    if theta is None:
        fit = fit_window(here, start[None])
        if not (fit.converged and np.isfinite(fit.chi2)):
            return None
        theta = fit.theta
    noise = here.noise(theta)
    if noise.dead:
        return None
    r, J = (part[0] for part in here.residual(noise, theta[None]))
    # residuals fall as the mean rises
    K = np.array([(r - at(values + step).residual(noise, theta[None])[0][0]) / step.sum() for step in np.diag(_STEP)])
    freedom = max(len(r) - len(J), 1)
    excess = max(float(np.minimum(r * r, _OUTLIER**2).sum()) / freedom, 1.0)
    A = J @ J.T
    light2 = float(theta[2] ** 2 * A[2, 2])
    # where the room's misfit alone could pass for the share, nothing is said of the light
    told = light2 * UNLIKE**2 > _ROOM_EXCESS * freedom
    unlike = _unlike(float(r @ r), freedom, light2) if told else 0.0
    return _Linear(theta, A, J @ K.T, K @ K.T, J @ r, K @ r, excess, unlike)


def _of_data(image: SpotPicture, data: SpotData, values: Array) -> _Linear | None:
    known = None if data.pixels.levels.shape[1] else data.pixels.background_e

    def at(shape: Array) -> SpotPixels:
        return _pixels(image, shape, data.regions.filters, known)

    model = SpotModel(_response(image.pair, values), known)
    fit = fit_law(data.regions, data.law, _blur(image, values), model, image.uv_px)
    if fit.status[0] != Status.OK:
        return None
    levels = fit.background_e[0] if known is None else np.zeros(0)
    theta = np.concatenate([fit.uv_px[0] - data.regions.origin_px[0], fit.flux_e[:1], levels])
    mean, derivatives = at(values).at(theta[None])
    J = derivatives.reshape(len(theta), -1)
    K = np.array([((at(values + step).at(theta[None])[0] - mean) / step.sum()).ravel() for step in np.diag(_STEP)])
    used = data.regions.used
    w = np.where(used, data.law.information(mean), 0.0).ravel()
    s = np.where(used, data.law.score(np.where(used, data.regions.x_e, 0.0), mean), 0.0).ravel()
    square, freedom = s * s / np.maximum(w, 1e-12), max(int(used.sum()) - len(J), 1)
    excess = max(float(np.minimum(square, _OUTLIER**2).sum()) / freedom, 1.0)
    A = (J * w) @ J.T
    unlike = _unlike(float(square.sum()), freedom, float(theta[2] ** 2 * A[2, 2]))
    return _Linear(theta, A, (J * w) @ K.T, (K * w) @ K.T, J @ s, K @ s, excess, unlike)


def _pixels(image: SpotPicture, values: Array, filters: Any, background_e: Array | None) -> SpotPixels:
    return SpotPixels.of(filters, _blur(image, values), SpotModel(_response(image.pair, values), background_e))


def _blur(image: SpotPicture, values: Array) -> Any:
    rig = replace(image.pair.rig, camera=replace(image.pair.rig.camera, blur_sigma_px=float(values[0])))
    return pair_blur(replace(image.pair, rig=rig), image.uv_px, image.depth_m)


def _response(pair: Pair, values: Array) -> tuple[float, float, float] | None:
    red = pair.rig.camera.detector.laser_filter_response[0]
    return (red, red * float(values[1]), red * float(values[2])) if pair.card.mosaic == "bayer" else None


# -- all pictures ----------------------------------------------------------------------------------------------------


def _together(parts: Sequence[_Linear]) -> tuple[Array, Array]:
    """Scores (n, 3) and informations (n, 3, 3) of pictures whose shapes differ by `_FIELD`: no bright spot rules."""
    M, scores, informations = np.diag(_FIELD) ** 2, [], []
    for part in parts:
        score, information = part.profiled()
        less = np.linalg.inv(np.eye(3) + information @ M)
        scores.append(less @ score)
        informations.append(less @ information)
    return np.array(scores), np.array(informations)


def _scatter(scores: Array, informations: Array) -> float:
    """Variance of the pictures' own blurs over what they claim, where it is above 1."""
    if len(scores) < 3:
        return 1.0
    own = np.maximum(informations[:, 0, 0], 1e-12)
    return max(float(np.sum(scores[:, 0] ** 2 / own)) / (len(scores) - 1), 1.0)
