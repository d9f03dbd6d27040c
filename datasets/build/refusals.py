"""Samples that are refused: which they are by a journal, their causes, and what a run says of them.

A sample is refused that cannot be drawn, or one of whose tasks cannot be done: its certificates, its noise, its room.
Both follow from recipe, code and versions. The journal keeps the refusals of tasks with their keys.

A data set may be finished without its refused samples. They are settled then: `dataset.json` lists them. All tasks of a
sample that is not settled are run as far as their needs go, also after a kill. So the same refusals, causes and bytes
come out in whatever order tasks end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from phibench.datasets.build.journal import Journal
from phibench.datasets.build.task_list import sample_task_name
from phibench.datasets.build.tasks import BuildTask
from phibench.datasets.plan.plan import Plan
from phibench.datasets.store import schema
from phibench.datasets.store.documents import parse_info

OPTION = "--leave-out-refused"
_TOLD = 20  # samples or failures that are told in full


def forget_others(journal: Journal, tasks: Mapping[str, BuildTask]) -> None:
    """Forget refusals of tasks that are not among these, or are made from other values now."""
    journal.keep_refusals(
        name for name, task in tasks.items() if name in journal.refusals and journal.refusals[name].key == task.key
    )


def refused_samples(plan: Plan, tasks: Mapping[str, BuildTask], journal: Journal) -> dict[str, str]:
    """Cause by id of all samples that cannot be drawn or made, in the order of the recipe.

    Of several refused tasks of a sample the first one counts, by the order of `needs` from its last task on.
    """
    found = dict(plan.refused)
    if journal.refusals:
        for pair in plan.pairs:
            if (culprit := _culprit(sample_task_name(pair), tasks, journal)) is not None:
                found[pair.sample_id] = journal.refusals[culprit].refused
    return {name: found[name] for name in plan.sample_ids if name in found}


def settled_samples(plan: Plan, tasks: Mapping[str, BuildTask], journal: Journal) -> dict[str, str]:
    """Cause by id of those refused samples without which the folder was finished."""
    try:
        held = {} if journal.head is None else parse_info(journal.head.info).causes
    except ValueError:  # of another version
        return {}
    return {name: cause for name, cause in refused_samples(plan, tasks, journal).items() if name in held}


def possible(names: Sequence[str], tasks: Mapping[str, BuildTask], journal: Journal) -> list[str]:
    """Names of those tasks that are not refused, nor is what they need."""
    return [name for name in names if _culprit(name, tasks, journal) is None] if journal.refusals else list(names)


def _culprit(name: str, tasks: Mapping[str, BuildTask], journal: Journal) -> str | None:
    """First refused task among a task and what it needs."""
    for need in tasks[name].needs:
        if (found := _culprit(need, tasks, journal)) is not None:
            return found
    return name if name in journal.refusals else None


def listed(first: str, lines: Sequence[str]) -> str:
    """A sentence, and some lines below it; of many the first ones."""
    more = [f"  and {len(lines) - _TOLD} more, see {schema.LOG}"] if len(lines) > _TOLD else []
    return "\n".join([first, *(f"  {line}" for line in lines[:_TOLD]), *more])


def incomplete_text(plan: Plan, refused: Mapping[str, str]) -> str:
    """One sentence for each refused sample of an unfinished data set: which, why, and what to do."""
    order, count = list(refused), len(plan.sample_ids)
    remedy = "change its target, its stroke or its rig"
    if plan.recipe.random is not None:
        number = int(order[0].rsplit("-", 1)[1])  # the samples of a shard are numbered as in the whole
        fewer = f", or `--samples {number}` for those before {order[0]} alone" if number and plan.shard is None else ""
        remedy = f"give another seed{fewer}"
    lines = [f"{name} is refused: {refused[name]}; {remedy}" for name in order]
    first = f"{len(refused)} of {count} samples are refused, all others are kept; the data set is not finished"
    finish = f" (`phibench dataset make ... {OPTION}` finishes it without them)" if len(refused) < count else ""
    return listed(f"{first}{finish}:", lines)


def left_out_line(left_out: Mapping[str, str], others: int) -> str:
    """Sentence on the samples that a finished data set leaves out, beside so many others."""
    names = list(left_out)
    which = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    verb = "is" if len(names) == 1 else "are"
    return f"{len(names)} of {len(names) + others} samples {verb} refused and left out: {which}"


def left_out_text(left_out: Mapping[str, str], others: int) -> str:
    """The same with a line for each sample and its cause."""
    first = f"{left_out_line(left_out, others)}; {schema.INFO} lists them:"
    return listed(first, [f"{name}: {cause}" for name, cause in left_out.items()])
