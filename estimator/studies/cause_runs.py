"""All nested samplings of the study, side by side in processes of their own."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from phibench.estimator.studies.cause_model import Model, without_table
from phibench.estimator.studies.cause_sampler import Posterior, pooled, sample
from phibench.estimator.studies.cause_settings import CauseSettings, Truth
from phibench.estimator.studies.cause_simulation import simulate
from phibench.estimator.studies.paper_reading import TABLES, published_experiments
from phibench.scenes.streams import Name, generator


@dataclass(frozen=True)
class Run:
    """One nested sampling.

    Parameters
    ----------
    key : tuple
        What it is for; also the names of its random stream.
    model : Model
    live_points : int
    stop : float
    """

    key: tuple[Name, ...]
    model: Model
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
            made = made_up(settings, truth, number, repeat)
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
        result[key] = pooled([posteriors[(*key, *again)] for again in _again(settings.repeats)], *key)
    return result


def _again(repeats: int) -> list[tuple[Name, ...]]:
    """What is added to the key of each repetition; nothing for the first."""
    return [(), *((repeat,) for repeat in range(1, repeats))]


def made_up(settings: CauseSettings, truth: Truth, number: int, repeat: int) -> Model:
    """The explanation of a truth with data that it has made."""
    data = published_experiments()
    model = settings.model(truth.explanation, data)
    point = np.array([[truth.values[name] for name in model.names]])
    estimates = simulate(model, point, generator("study", "cause", "made-up", number, repeat))[0]
    return settings.model(truth.explanation, data.with_estimates(estimates))


def run_all(runs: Sequence[Run], workers: int | None) -> dict[tuple[Name, ...], Posterior]:
    """Posteriors by key; the number of workers changes no number, because each run has its own random stream."""
    count = min(workers or os.cpu_count() or 1, len(runs))
    if count <= 1:
        return {run.key: _sampled(run) for run in runs}
    # spawned: forking a process that has threads (polars) can hang
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
        return dict(zip((run.key for run in runs), pool.map(_sampled, runs), strict=True))


def _sampled(run: Run) -> Posterior:
    return sample(run.model, run.live_points, run.stop, *run.key)
