"""Study `cause`: which explanation of the paper's 25 estimates the numbers support, and what they cannot decide."""

from __future__ import annotations

from phibench.estimator.studies import cause_findings as say
from phibench.estimator.studies import cause_tables as tables
from phibench.estimator.studies.cause_drawing import evidence_drawing, posterior_drawing, predictive_drawing
from phibench.estimator.studies.cause_evidence import ENOUGH, FLOOR
from phibench.estimator.studies.cause_runs import all_runs, pooled_runs, run_all
from phibench.estimator.studies.cause_sampler import require_sampler
from phibench.estimator.studies.cause_settings import CauseSettings, require_consistent
from phibench.estimator.studies.material import Material
from phibench.estimator.studies.result import Result
from phibench.estimator.studies.study import Study

_LIMITS = (
    "no azimuth, spot height, lens distance or way of reading is in the paper: all are drawn from priors, "
    "and evidences depend on these",
    "the decentre has its component along the tilt alone, which restricts the prior: where spots are 45 to 135 deg "
    "from the tilt, 1 mm across it moves the estimates by more (1.0 to 2.1 % rms) than 1 mm along it (0.2 to 1.9 %); "
    "azimuths from 0 to 180 deg are all of them only because of that",
    "a tilted stroke axis, lens distortion, a mirror out of round and errors that change from day to day are not among "
    "the explanations",
)


def run(settings: CauseSettings, material: Material) -> Result:
    """Run the study; it needs no data set."""
    require_consistent(settings)
    require_sampler()
    runs = all_runs(settings)
    posteriors = pooled_runs(run_all(runs, material.workers), settings)
    table = tables.explanation_table(settings, posteriors)
    scales = tables.scale_table(settings, posteriors)
    posterior = tables.posterior_table(settings, posteriors)
    offsets = tables.offset_table(settings, posteriors)
    correlations = tables.correlation_table(settings, posteriors)
    alike = tables.alike_table(settings, posteriors)
    made_up = tables.made_up_table(settings, posteriors, runs)
    density = tables.density_table(settings, posteriors)
    short = tables.short_stroke_table()
    best = say.best_sentence(table)
    words = (
        best,
        say.convention_sentence(settings, table),
        say.noise_sentence(table),
        *say.rival_sentences(table),
        say.offset_sentence(table, offsets),
        say.scale_sentence(scales),
        say.left_out_sentence(table),
        say.alike_sentence(settings, alike, correlations),
        say.made_up_sentence(made_up),
        say.density_sentence(density),
        say.short_stroke_sentence(short),
    )
    drawn = ", ".join(f"'{settings.explanation(name).text}'" for name in settings.drawn)
    return Result(
        {
            "table": table,
            "prior_scales": scales,
            "posterior": posterior,
            "offsets": offsets,
            "correlations": correlations,
            "alike": alike,
            "left_out": tables.left_out_table(settings, posteriors),
            "made_up": made_up,
            "density": density,
            "short_stroke": short,
        },
        tuple(filter(None, words)),
        (
            predictive_drawing(
                settings, posteriors, f"Published errors over 90 % bands and medians of {drawn}. {best}"
            ),
            evidence_drawing(table, scales, f"Log evidence of {len(table)} explanations. {best}"),
            posterior_drawing(settings, posteriors, f"Posteriors of {drawn}. {say.noise_sentence(table)}"),
        ),
        {
            "Explanations, best first": say.explanations_shown(table),
            **{
                f"Posterior of '{settings.explanation(name).text}'": say.posterior_shown(posterior, name)
                for name in settings.drawn
            },
        },
        _LIMITS + _left_out(settings),
    )


def _left_out(settings: CauseSettings) -> tuple[str, ...]:
    few = (
        f"each explanation was sampled {settings.repeats} time(s), too few to measure the scatter: the error of a log "
        f"evidence is taken for {FLOOR:g} at least"
    )
    return (
        *((few,) if settings.repeats < ENOUGH else ()),
        *(() if settings.prior_scales else ("priors were not widened",)),
    )


STUDY = Study(
    "cause",
    "What made the paper's error curves",
    "Which combination of sense of phi, misalignment, reading noise and unknown rig numbers explains the 25 published "
    "estimates best, and what can they not decide?",
    CauseSettings,
    run,
)
