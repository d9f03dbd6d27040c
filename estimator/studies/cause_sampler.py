"""Posterior and evidence of a model by nested sampling, with dynesty.

J. S. Speagle, Mon. Not. R. Astron. Soc. 493, 3132 (2020); J. Skilling, Bayesian Analysis 1, 833 (2006).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phibench.datasets.errors import DatasetError
from phibench.estimator.studies.cause_model import Model
from phibench.scenes.frames import Array
from phibench.scenes.streams import Name, generator


@dataclass(frozen=True)
class Posterior:
    """What nested sampling says of a model.

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


def pooled(runs: Sequence[Posterior], *names: Name) -> Posterior:
    """One posterior of several independent samplings of a model.

    The evidence is the mean of theirs, with the larger of the samplers' own error and of their scatter; draws are taken
    from each run in proportion to its evidence.
    """
    if len(runs) == 1:
        return runs[0]
    logs, own = (np.array([getattr(run, name) for run in runs]) for name in ("log_evidence", "log_evidence_error"))
    weights = np.exp(logs - logs.max())
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


def sample(model: Model, live_points: int, stop: float, *names: Name) -> Posterior:
    """Run nested sampling.

    Parameters
    ----------
    model : Model
    live_points : int
    stop : float
        Remaining log evidence at which it ends.
    *names
        Of the random stream.
    """
    require_sampler()
    from dynesty import NestedSampler

    random = generator("study", "cause", "sampler", *names)
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
    found = sampler.results
    return Posterior(
        np.asarray(found.samples_equal(rstate=random)),
        float(found.logz[-1]),
        float(found.logzerr[-1]),
        int(np.sum(found.ncall)),
    )
