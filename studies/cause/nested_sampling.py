"""Bayesian comparison of the models of study `cause`: settings, and nested sampling of posterior and evidence.

Data made from known causes test the comparison.

J. S. Speagle, Mon. Not. R. Astron. Soc. 493, 3132 (2020), dynesty; J. Skilling, Bayesian Analysis 1, 833 (2006). The
samplings of a study run side by side in processes of their own; each has its own random stream.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from phibench.datasets.common.errors import DatasetError
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import Rig
from phibench.scenes.validation import nearest
from phibench.studies.cause.model import COMMON, GROUPS, NOISE, DepthModel, Explanation, Prior, simulate, without_table
from phibench.studies.cause.paper_reading import AZIMUTHS, TABLES, Experiments, published_experiments
from phibench.studies.framework import Settings


@dataclass(frozen=True)
class Posterior:
    """Posterior and evidence of a model, from nested sampling.

    Attributes
    ----------
    points : shape (m, d)
        Draws from the posterior, equally weighted.
    log_evidence, log_evidence_error : float
        Of the published estimates in metres; the error is one sigma of the sampler.
    evaluations : int
        Of the likelihood.
    """

    points: Array
    log_evidence: float
    log_evidence_error: float
    evaluations: int

    def thinned(self, count: int) -> Array:
        """Up to so many draws, evenly picked."""
        return self.points[np.linspace(0, len(self.points) - 1, min(count, len(self.points))).astype(int)]


def pooled_posterior(runs: Sequence[Posterior], *names: Name) -> Posterior:
    """One posterior of several independent samplings of a model.

    The evidence is the mean of theirs, with the larger of the samplers' own error and of their scatter; draws are taken
    from each run in proportion to its evidence.
    """
    if len(runs) == 1:
        return runs[0]  # its draws as they are
    logs, own = (np.array([getattr(run, name) for run in runs]) for name in ("log_evidence", "log_evidence_error"))
    # relative to the largest: the exponential of a log evidence itself may leave the range of doubles
    weights = np.exp(logs - logs.max())
    # the sampler only estimates its own error: where repeated samplings scatter more, their scatter counts
    error = max(float(np.sqrt(np.mean(own**2))), float(logs.std(ddof=1))) / np.sqrt(len(runs))
    random, count = generator("study", "cause", "pooled", *names), max(len(run.points) for run in runs)
    chosen = random.multinomial(count, weights / weights.sum())
    points = [run.points[random.integers(len(run.points), size=n)] for run, n in zip(runs, chosen, strict=True)]
    evaluations = sum(run.evaluations for run in runs)
    return Posterior(np.concatenate(points), float(logs.max() + np.log(weights.mean())), error, evaluations)


def require_sampler() -> None:
    """Raise `DatasetError` if dynesty is not installed."""
    try:
        import dynesty  # noqa: F401
    except ImportError as error:
        raise DatasetError("the study needs the package dynesty: pip install 'phibench[study]'") from error


def nested_sample(model: DepthModel, live_points: int, stop: float, *names: Name) -> Posterior:
    """Run nested sampling.

    Parameters
    ----------
    model : DepthModel
    stop : float
        Remaining log evidence at which it ends.
    *names
        Of the random stream.
    """
    require_sampler()
    from dynesty import NestedSampler

    random = generator("study", "cause", "sampler", *names)
    # random walks, unlike uniform draws, need no bound that holds the whole contour of the likelihood
    sampler = NestedSampler(
        model.log_likelihood,
        model.point,
        len(model.names),
        nlive=live_points,
        bound="multi",
        sample="rwalk",
        rstate=random,
    )
    sampler.run_nested(dlogz=stop, print_progress=False)
    results = sampler.results
    return Posterior(
        np.asarray(results.samples_equal(rstate=random)),
        float(results.logz[-1]),
        float(results.logzerr[-1]),
        int(np.sum(results.ncall)),
    )


class MadeUpWorld(Settings):
    """A known world to make data in."""

    explanation: str
    values: dict[str, float] = Field(description="of every free parameter of the explanation")


class Validation(Settings):
    """Made-up data."""

    candidates: list[str] = Field(min_length=1, description="explanations that are tried on them")
    repeats: int = Field(ge=1, le=100)
    truths: list[MadeUpWorld]


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
        """Settings that do not fit together, a sentence each."""
        return tuple(filter(None, (*_faults_of_names(self), *_faults_of_priors(self), *_faults_of_truths(self))))

    def explanation(self, name: str) -> Explanation:
        """Explanation of a name."""
        return next(explanation for explanation in self.explanations if explanation.name == name)

    def model(self, name: str, experiments: Experiments, scale: float = 1.0) -> DepthModel:
        """Model of an explanation; normal priors of what may be wrong are `scale` times as wide."""
        explanation = self.explanation(name)
        priors = {**self.priors, **explanation.priors}
        scaled = {n: prior if n in COMMON else prior.scaled(scale) for n, prior in priors.items()}
        return DepthModel(explanation, scaled, experiments, Rig(), self.depth_sigma_m)


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


@dataclass(frozen=True)
class Run:
    """One nested sampling.

    Parameters
    ----------
    key : tuple
        What it is for; also the names of its random stream.
    model : DepthModel
    """

    key: tuple[Name, ...]
    model: DepthModel
    live_points: int
    stop: float


def all_runs(settings: CauseSettings) -> list[Run]:
    """Every sampling that the settings ask for: published data, other priors, left-out tables, made-up data."""
    data, few, stop = published_experiments(), settings.live_points_other, settings.stop
    names = [explanation.name for explanation in settings.explanations]
    runs = [
        Run(("published", n, *again), settings.model(n, data), settings.live_points, stop)
        for n in names
        for again in _again(settings.repeats)
    ]
    for scale in settings.prior_scales:
        runs += [Run(("scale", f"{scale:g}", n), settings.model(n, data, scale), few, stop) for n in settings.scaled]
    for n in settings.left_out:
        for table in range(TABLES):
            model, _ = without_table(settings.model(n, data), table)
            runs.append(Run(("without", table, n), model, few, stop))
    for number, truth in enumerate(settings.validation.truths):
        for repeat in range(settings.validation.repeats):
            made = made_up_model(settings, truth, number, repeat)
            for n in settings.validation.candidates:
                model = settings.model(n, made.experiments)
                runs.append(Run(("made-up", number, repeat, n), model, few, stop))
    return runs


def pooled_runs(
    posteriors: Mapping[tuple[Name, ...], Posterior], settings: CauseSettings
) -> dict[tuple[Name, ...], Posterior]:
    """Posteriors by key, those of repeated samplings pooled under the key of the first."""
    result = dict(posteriors)
    for explanation in settings.explanations:
        key = ("published", explanation.name)
        result[key] = pooled_posterior([posteriors[(*key, *again)] for again in _again(settings.repeats)], *key)
    return result


def _again(repeats: int) -> list[tuple[Name, ...]]:
    """Additions to the key of each repetition; none for the first."""
    # the first keeps the bare key: more repeats add random streams and change none
    return [(), *((repeat,) for repeat in range(1, repeats))]


def made_up_model(settings: CauseSettings, truth: MadeUpWorld, number: int, repeat: int) -> DepthModel:
    """The explanation of a truth with data that it has made."""
    data = published_experiments()
    model = settings.model(truth.explanation, data)
    point = np.array([[truth.values[name] for name in model.names]])
    estimates = simulate(model, point, generator("study", "cause", "made-up", number, repeat))[0]
    return settings.model(truth.explanation, data.with_estimates(estimates))


def posterior_of_run(run: Run) -> Posterior:
    """Posterior of a run: it has its own random stream, so that no other run changes it."""
    return nested_sample(run.model, run.live_points, run.stop, *run.key)
