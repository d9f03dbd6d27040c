"""Work that earlier runs left in a folder: finished samples that a run would lose, refused ones, sentences on both.

Work is finished when the journal has its line and its files have the bytes that the line tells. Where lines of the
journal are lost, SHA256SUMS of a finished data set vouches for files. Camera frames are no such work: they are drawn
from the layers in seconds, in folders of their own.

A finished data set of more samples than a run asks for is kept whole: its first samples are those that are asked for.

A sample is refused that cannot be drawn, or one of whose tasks cannot be done: its certificates, its noise, its room.
Both follow from recipe, code and versions. The journal keeps the refusals of tasks with their keys. A data set may be
finished without its refused samples. They are settled then: `dataset.json` lists them. All tasks of a sample that is
not settled are run as far as their needs go, also after a kill. So the same refusals, causes and bytes come out in
whatever order tasks end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from phibench.datasets.build.dataset_build import held_head, listed_text, plan_tasks, sample_task_name
from phibench.datasets.build.journal import Entry, FolderHead, Journal, is_intact
from phibench.datasets.build.task_runner import intact
from phibench.datasets.build.tasks import BuildTask
from phibench.datasets.build.workers import versions
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.plan.plan import Plan, make_plan
from phibench.datasets.recipe.load import parse_recipe
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import held_room_files, read_checksums
from phibench.datasets.store.metadata import parse_info
from phibench.datasets.store.provenance import code_sha256
from phibench.datasets.store.schema import DatasetInfo

OPTION = "--leave-out-refused"
OR_REPLACE = "give another folder, or add `--replace` to delete them"
_NOT_IN_KEYS = ("dataset", "frames", "distractors")
"""Tables of a recipe: the first is told by itself, on the others no task depends."""
_ENVIRONMENT = ("python", "machine", "packages", "variant", "llvm", "threads_per_process")


class LostWorkError(DatasetError):
    """Finished work would be lost; nothing has been changed."""


def lost_work_text(out: Path, keys: Mapping[str, str], journal: Journal, wanted: DatasetInfo) -> str | None:
    """Finished work that a run would delete or make again, as the beginning of a sentence; None if there is none.

    Parameters
    ----------
    out : folder
    keys : key of every task of the run, by name
    journal : that of the folder
    wanted : description of the data set that the run makes
    """
    tasks = _lost_tasks(out, keys, journal)
    files = [] if tasks else _lost_files(out, keys, journal, wanted)
    if not tasks and not files:
        return None  # everything that is there belongs to this run
    counts = Counter(name.split(" ", 1)[0] for name in tasks)
    parts = ", ".join(f"{count} {kind}{'s' * (count != 1)}" for kind, count in counts.items())
    what = f"{len(tasks)} finished task{'s' * (len(tasks) != 1)} ({parts})"
    if files:
        what = f"{len(files)} finished file{'s' * (len(files) != 1)}, such as {files[0]},"
    causes = " and ".join(_causes(_held_info(out, journal), wanted))
    return f"{out} holds {what} that this run would delete or make again, they were made with {causes}"


def left_out_sentence(out: Path, journal: Journal) -> str | None:
    """Sentence on a finished data set that leaves samples out, which a run that needs them all would undo."""
    info = _held_info(out, journal)
    if info is None or not info.left_out or not (out / schema.CHECKSUMS).is_file():
        return None  # nothing was left out before
    keep = f"add `{OPTION}` to keep it so, or `--replace` to try them again"
    return f"{out} is finished, and {left_out_line(info.causes, info.samples)}; {keep}"


def _lost_tasks(out: Path, keys: Mapping[str, str], journal: Journal) -> list[str]:
    """Tasks whose files are good, and which the run does not have or makes from other values."""
    other = [name for name, entry in journal.entries.items() if entry.files and keys.get(name) != entry.key]
    return [name for name, good in zip(other, intact([journal.entries[n] for n in other], out), strict=True) if good]


def _lost_files(out: Path, keys: Mapping[str, str], journal: Journal, wanted: DatasetInfo) -> list[str]:
    """Files that SHA256SUMS vouches for and the journal does not know, where the run's tasks are not the folder's."""
    try:
        listed = read_checksums(out)
    except DatasetError:  # not finished, or nobody can tell
        return []
    known = {name for entry in journal.entries.values() for name in entry.files}
    unknown = {name: digest for name, digest in listed.items() if schema.is_task_file(name) and name not in known}
    if not unknown or _held_keys(out, journal, wanted).items() <= keys.items():
        return []  # the journal knows all of it, or the same keys made it
    return [name for name, digest in unknown.items() if is_intact(Entry("", "", {name: digest}), out)]


def _held_keys(out: Path, journal: Journal, wanted: DatasetInfo) -> dict[str, str]:
    """Keys of the tasks that made a folder, by its own description; one that nothing has if that does not tell."""
    unlike = {"": ""}
    head, info = _held_head(out, journal), _held_info(out, journal)
    if head is None or info is None or info.provenance.get("code_sha256") != code_sha256():
        return unlike
    try:
        plan = make_plan(parse_recipe(head.recipe), held_room_files(out), info.shard).without(info.causes)
        # a description that `repair` has recovered does not know the renderer
        environment = versions({**wanted.provenance, **info.provenance})
        return {name: task.key for name, task in plan_tasks(plan, environment).items()}
    except (DatasetError, KeyError, TypeError):  # a description that somebody changed
        return unlike


def _held_head(out: Path, journal: Journal) -> FolderHead | None:
    return journal.head or held_head(out)


def _held_info(out: Path, journal: Journal) -> DatasetInfo | None:
    head = _held_head(out, journal)
    try:
        return None if head is None else parse_info(head.info)
    except ValueError:  # of another version
        return None


def _causes(held: DatasetInfo | None, wanted: DatasetInfo) -> list[str]:
    """Differences of two descriptions, in words; a seed may be a secret and is not told."""
    if held is None:
        return ["another version of phibench"]
    causes = [f"the name '{held.name}'"] if held.name != wanted.name else []
    old, new = held.recipe, wanted.recipe
    table = old.get("dataset")
    if not isinstance(table, dict) or table.get("seed") != new["dataset"]["seed"]:
        causes.append("another seed")
    if held.shard != wanted.shard:
        causes.append(f"shard {held.shard}" if held.shard else "no shard")
    for name in new:
        if name not in _NOT_IN_KEYS and old.get(name) != new[name]:
            causes.append(_table_cause(name, old.get(name), new[name]))
    if held.provenance.get("code_sha256") != wanted.provenance["code_sha256"]:
        causes.append("other code")
    unlike = (name for name in _ENVIRONMENT if held.provenance.get(name) != wanted.provenance.get(name))
    return [*causes, *(f"another {name}" for name in unlike)] or ["other values"]


def _table_cause(name: str, old: Any, new: Any) -> str:
    drawn = name == "random" and isinstance(old, dict) and isinstance(new, dict)
    return f"{old['samples']} samples" if drawn and {**old, "samples": new["samples"]} == new else f"another [{name}]"


def kept_sample_count(out: Path, recipe: Recipe) -> int | None:
    """Number of samples of the finished data set in a folder, if it has more of the same than a recipe asks for."""
    if recipe.random is None or not (out / schema.CHECKSUMS).is_file():
        return None  # experiments have no number of samples
    head = held_head(out)
    try:
        if head is None or parse_info(head.info).shard is not None:
            return None  # nothing there, or a shard, whose number says nothing
        held = parse_recipe(head.recipe)
    except ValueError:  # of another version
        return None
    if held.random is None or held.dataset != recipe.dataset or held.random.samples <= recipe.random.samples:
        return None  # another data set, or not more
    return held.random.samples


# Samples that are refused.


def forget_others(journal: Journal, tasks: Mapping[str, BuildTask]) -> None:
    """Forget refusals of tasks that are not among these, or are made from other values now."""
    journal.keep_refusals(
        name for name, task in tasks.items() if name in journal.refusals and journal.refusals[name].key == task.key
    )


def refused_samples(plan: Plan, tasks: Mapping[str, BuildTask], journal: Journal) -> dict[str, str]:
    """Cause by id of all samples that cannot be drawn or made, in the order of the recipe.

    Of several refused tasks of a sample the first one counts, by the order of `needs` from its last task on.
    """
    refused = dict(plan.refused)
    if journal.refusals:
        for pair in plan.pairs:
            if (culprit := _culprit(sample_task_name(pair), tasks, journal)) is not None:
                refused[pair.sample_id] = journal.refusals[culprit].refused
    return {name: refused[name] for name in plan.sample_ids if name in refused}


def settled_samples(plan: Plan, tasks: Mapping[str, BuildTask], journal: Journal) -> dict[str, str]:
    """Cause by id of those refused samples without which the folder was finished."""
    try:
        held = {} if journal.head is None else parse_info(journal.head.info).causes
    except ValueError:  # of another version
        return {}
    return {name: cause for name, cause in refused_samples(plan, tasks, journal).items() if name in held}


def possible_tasks(names: Sequence[str], tasks: Mapping[str, BuildTask], journal: Journal) -> list[str]:
    """Names of those tasks that are not refused, nor is what they need."""
    return [name for name in names if _culprit(name, tasks, journal) is None] if journal.refusals else list(names)


def _culprit(name: str, tasks: Mapping[str, BuildTask], journal: Journal) -> str | None:
    """First refused task among a task and what it needs."""
    for need in tasks[name].needs:
        if (culprit := _culprit(need, tasks, journal)) is not None:
            return culprit
    return name if name in journal.refusals else None


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
    return listed_text(f"{first}{finish}:", lines)


def left_out_line(left_out: Mapping[str, str], others: int) -> str:
    """Sentence on the samples that a finished data set leaves out, beside so many others."""
    names = list(left_out)
    which = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    verb = "is" if len(names) == 1 else "are"
    return f"{len(names)} of {len(names) + others} samples {verb} refused and left out: {which}"


def left_out_text(left_out: Mapping[str, str], others: int) -> str:
    """The same with a line for each sample and its cause."""
    first = f"{left_out_line(left_out, others)}; {schema.INFO} lists them:"
    return listed_text(first, [f"{name}: {cause}" for name, cause in left_out.items()])
