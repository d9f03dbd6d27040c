"""Settings of the study `cause`."""

from __future__ import annotations

from pydantic import Field, model_validator

from phibench.estimator.studies.cause_model import COMMON, GROUPS, NOISE, Explanation, Model, Prior
from phibench.estimator.studies.paper_reading import AZIMUTHS, Experiments
from phibench.estimator.studies.study import Settings
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

    @model_validator(mode="after")
    def _known(self) -> CauseSettings:
        names = [explanation.name for explanation in self.explanations]
        if len(set(names)) < len(names):
            raise ValueError(f"explanations have the same name: {sorted({n for n in names if names.count(n) > 1})}")
        truths = [truth.explanation for truth in self.validation.truths]
        if unknown := {*self.scaled, *self.left_out, *self.drawn, *self.validation.candidates, *truths} - set(names):
            raise ValueError(f"no explanation {', '.join(sorted(unknown))}; there are {', '.join(names)}")
        for truth in self.validation.truths:
            if missing := set(self.explanation(truth.explanation).parameters) - set(truth.values):
                raise ValueError(f"validation of {truth.explanation}: no value of {', '.join(sorted(missing))}")
        needed = {NOISE, *COMMON, *AZIMUTHS, *(name for group in GROUPS.values() for name in group)}
        if missing := needed - set(self.priors):
            raise ValueError(f"no prior of {', '.join(sorted(missing))}")
        if any(not scale > 0.0 for scale in self.prior_scales):
            raise ValueError("prior_scales must be above 0")
        return self

    def explanation(self, name: str) -> Explanation:
        """Explanation of a name."""
        return next(explanation for explanation in self.explanations if explanation.name == name)

    def model(self, name: str, experiments: Experiments, scale: float = 1.0) -> Model:
        """Model of an explanation; normal priors of what may be wrong are `scale` times as wide."""
        explanation = self.explanation(name)
        priors = {**self.priors, **explanation.priors}
        scaled = {n: prior if n in COMMON else prior.scaled(scale) for n, prior in priors.items()}
        return Model(explanation, scaled, experiments, Rig(), self.depth_sigma_m)
