"""Settings of the study `cause`."""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import Field

from phibench.datasets.errors import DatasetError
from phibench.estimator.studies.cause_model import COMMON, GROUPS, NOISE, Explanation, Model, Prior
from phibench.estimator.studies.paper_reading import AZIMUTHS, Experiments
from phibench.estimator.studies.study import Settings
from phibench.scenes.names import nearest
from phibench.scenes.rig import Rig


class Truth(Settings):
    """A known world to make data in."""

    explanation: str
    values: dict[str, float] = Field(description="of every free parameter of the explanation")


class Validation(Settings):
    """Made-up data."""

    candidates: list[str] = Field(min_length=1, description="explanations that are tried on them")
    repeats: int = Field(ge=1, le=100)
    truths: list[Truth]


class CauseSettings(Settings):
    """Settings of the study `cause`; the first explanation is what the others are compared with."""

    live_points: int = Field(ge=20, le=5000)
    live_points_other: int = Field(ge=20, le=5000)
    repeats: int = Field(ge=1, le=100, description="independent samplings of each explanation")
    stop: float = Field(gt=0.0, le=20.0)
    prior_scales: list[float]
    scaled: list[str] = Field(description="explanations that are tried with them")
    predictive: int = Field(ge=20, le=100_000)
    brute_force: int = Field(ge=100, le=1_000_000)
    left_out: list[str]
    drawn: list[str] = Field(min_length=1)
    depth_sigma_m: float = Field(ge=0.0, le=0.1)
    priors: dict[str, Prior]
    explanations: list[Explanation] = Field(min_length=1)
    validation: Validation

    @property
    def faults(self) -> tuple[str, ...]:
        """What does not fit together, a sentence each."""
        return tuple(filter(None, (*_faults_of_names(self), *_faults_of_priors(self), *_faults_of_truths(self))))

    def explanation(self, name: str) -> Explanation:
        """Explanation of a name."""
        return next(explanation for explanation in self.explanations if explanation.name == name)

    def model(self, name: str, experiments: Experiments, scale: float = 1.0) -> Model:
        """Model of an explanation; normal priors of what may be wrong are `scale` times as wide."""
        explanation = self.explanation(name)
        priors = {**self.priors, **explanation.priors}
        scaled = {n: prior if n in COMMON else prior.scaled(scale) for n, prior in priors.items()}
        return Model(explanation, scaled, experiments, Rig(), self.depth_sigma_m)


def require_consistent(settings: CauseSettings) -> None:
    """Raise `DatasetError` with all faults, a line each, if the settings do not fit together."""
    if settings.faults:
        raise DatasetError("\n".join(["settings of the study 'cause':", *(f"  {fault}" for fault in settings.faults)]))


def _faults_of_names(settings: CauseSettings) -> Iterator[str]:
    names = [explanation.name for explanation in settings.explanations]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        yield f"explanations: two have the same name: {', '.join(twice)}; give each its own"
    asked = {
        "scaled": settings.scaled,
        "left_out": settings.left_out,
        "drawn": settings.drawn,
        "validation.candidates": settings.validation.candidates,
        "validation.truths": [truth.explanation for truth in settings.validation.truths],
    }
    for key, given in asked.items():
        for name in given:
            if name not in names:
                yield f"{key}: no explanation '{name}'; {nearest(name, names)}"


def _faults_of_priors(settings: CauseSettings) -> Iterator[str]:
    for name in (NOISE, *COMMON, *AZIMUTHS, *(name for group in GROUPS.values() for name in group)):
        if name not in settings.priors:
            yield f"priors: no prior of {name}; add one, such as {name} = {{ normal = [0.0, 1.0] }}"
    for name, prior in settings.priors.items():
        if prior.fault:
            yield f"priors.{name}: {prior.fault}"
    for explanation in settings.explanations:
        for name, prior in explanation.priors.items():
            if prior.fault or name not in explanation.parameters:
                yield f"explanation '{explanation.name}', priors.{name}: {prior.fault or 'is not free there'}"
    for scale in settings.prior_scales:
        if not scale > 0.0:
            yield f"prior_scales: {scale:g}; must be above 0"


def _faults_of_truths(settings: CauseSettings) -> Iterator[str]:
    known = {explanation.name: explanation for explanation in settings.explanations}
    for truth in settings.validation.truths:
        for name in known[truth.explanation].parameters if truth.explanation in known else ():
            if name not in truth.values:
                yield f"validation of '{truth.explanation}': no value of {name}; add it"
