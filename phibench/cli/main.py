"""The command line `phibench`: all commands put together; `cache`, `completion`, `doctor`; exit codes; old spellings.

Exit codes: 0 done, 1 checked and found wanting, 2 a mistake of the user or the machine in one sentence, 3 a fault of
phibench, 130 Ctrl-C, 129 SIGHUP, 143 SIGTERM.
Every command imports what it needs itself, so that ``--help`` is quick and scoring runs without Mitsuba.
"""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import takewhile
from pathlib import Path
from types import FrameType
from typing import Literal

from cyclopts import App, CycloptsError, Parameter

from phibench.cli.calibration import align, calibrate
from phibench.cli.captures import import_, measure, sensor
from phibench.cli.dataset import dataset
from phibench.cli.dense import dense
from phibench.cli.film import film
from phibench.cli.loop import loop
from phibench.cli.options import DATA, INSTALLATION, KEEPERS, METHODS, SENSOR, START
from phibench.cli.publish import export, fetch, release, seal, submission
from phibench.cli.room import room, scene
from phibench.cli.score import bench, compare, report, results, score
from phibench.cli.start import demo, method, recipe, start
from phibench.cli.studies import paper, stroke, study
from phibench.datasets.common.parallel import ONE_THREAD


def _version_line() -> str:
    """Version as `phibench --version` prints it; in a checkout with the commit and with what differs from it."""
    from phibench.datasets.store.provenance import program_version

    return program_version()


app = App(
    name="phibench",
    version=_version_line,
    help="Render an omnidirectional camera-mirror sensor with exact depth, and score depth estimators against it.",
    suppress_keyboard_interrupt=False,
    result_action="return_value",
    default_parameter=Parameter(negative_iterable=()),  # no --empty-distance-m beside --distance-m
)
for _group in (recipe, dataset, film, room, scene, method, dense, seal, submission, sensor, loop, study):
    app.command(_group)
app.command(start, group=START)
app.command(demo, group=START)
app.command(export, group=DATA)
app.command(release, group=KEEPERS)
app.command(fetch, group=DATA)
app.command(score, group=START)
app.command(bench, group=METHODS)
app.command(compare, group=METHODS)
app.command(report, group=START)
app.command(results, group=KEEPERS)
app.command(calibrate, group=SENSOR)
app.command(align, group=SENSOR)
app.command(measure, group=START)
app.command(import_, name="import", group=SENSOR)
app.command(paper, group=SENSOR)
app.command(stroke, group=SENSOR)


cache = App(name="cache", group=KEEPERS, help="Show, clear and limit the cache of baked rooms.")
app.command(cache)


@cache.command
def show() -> int:
    """List the light maps that are kept for all data sets, with their size and last use."""
    from datetime import datetime

    from phibench.datasets.build.bake_task import cache_entries, cache_limit_mb, light_map_cache

    entries = cache_entries()
    for entry in entries:
        used = datetime.fromtimestamp(entry.used_s).isoformat(" ", "minutes")
        print(f"{entry.path.stem[:12]}  {entry.size_bytes / 1e6:8.1f} MB  last used {used}")
    total = sum(entry.size_bytes for entry in entries) / 1e6
    print(f"{light_map_cache()}: {_maps(len(entries))}, {total:.1f} MB of at most {cache_limit_mb():g} MB")
    return 0


@cache.command
def clear() -> int:
    """Remove all light maps; a room is baked again when a data set needs it."""
    from phibench.datasets.build.bake_task import clear_cache, light_map_cache

    print(f"{light_map_cache()}: {_maps(clear_cache())} removed")
    return 0


@cache.command
def limit(megabytes: float) -> int:
    """Limit the light maps' size, from now on; those that were not used for longest go first.

    Parameters
    ----------
    megabytes
        Limit in 1e6 bytes; 0 keeps none.
    """
    from phibench.datasets.build.bake_task import light_map_cache, limit_cache

    gone = limit_cache(megabytes)
    print(f"{light_map_cache()}: at most {megabytes:g} MB from now on, {_maps(gone)} removed")
    return 0


def _maps(count: int) -> str:
    return f"{count} light map{'' if count == 1 else 's'}"


@app.command(group=INSTALLATION)
def completion(shell: Literal["bash", "zsh", "fish"]) -> int:
    """Print a script that lets the Tab key complete commands and options.

    For bash: phibench completion bash > ~/.local/share/bash-completion/completions/phibench

    Parameters
    ----------
    shell
        "bash", "zsh" or "fish".
    """
    print(app.generate_completion(shell=shell))
    if shell == "zsh":
        print(_ZSH_CALL)
    return 0


# zsh runs a file of its fpath as the function itself; cyclopts defines another one and does not call it.
_ZSH_CALL = """
if [[ "${funcstack[1]}" == _phibench ]]; then
  _cyclopts_phibench "$@"
else
  compdef _cyclopts_phibench phibench
fi"""


@app.command(group=INSTALLATION)
def doctor(*, variants: bool = False) -> int:
    """Show Python, packages, LLVM, cores and disk, and render a test image.

    The exit code is 1 if something is broken; an installation that can only score is not.

    Parameters
    ----------
    variants
        Render `smoke` with LLVM and with CUDA instead, a minute or two, and compare: truth to the bit, layers in sigma
        of phi. The exit code is 1 above 0.05 sigma.
    """
    if variants:
        return _compare_variants()
    # a bad LLVM aborts the process that loads it: never this one
    return subprocess.run([sys.executable, "-m", "phibench.render.setup.doctor"], check=False).returncode


def _compare_variants() -> int:
    import tempfile

    from phibench.datasets.make import make_with_variant
    from phibench.estimator.limits.variant_difference import table_of, variant_difference

    with tempfile.TemporaryDirectory(prefix="phibench-variants-") as folder:
        # CUDA first: where there is none, it says so at once
        cuda, llvm = (make_with_variant(name, "smoke", Path(folder) / name) for name in ("cuda", "llvm"))
        differences = variant_difference(llvm, cuda)
    print(table_of("llvm", "cuda", differences))
    return 0 if differences.agrees else 1


def main(tokens: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    if old := answer_to_old_spelling(sys.argv[1:] if tokens is None else tokens):
        print(f"phibench: {old}", file=sys.stderr)
        return 2
    for stream in (sys.stdout, sys.stderr):  # a letter that the terminal lacks is no reason to stop
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    for name, value in ONE_THREAD.items():  # of the processes that a command starts, too; who sets one has his way
        os.environ.setdefault(name, value)
    try:
        _refuse_strange(sys.argv[1:] if tokens is None else tokens)
        _refuse_little_memory(sys.argv[1:] if tokens is None else tokens)
        with _orderly_stop(), _told(sys.argv[1:] if tokens is None else tokens):
            return int(app(tokens, exit_on_error=False) or 0)
    except CycloptsError:
        return 2  # cyclopts has said what is wrong
    except _Stopped as stop:
        print(f"Stopped by {stop.number.name}.", file=sys.stderr)
        return 128 + stop.number  # as shells report a signal
    except KeyboardInterrupt:
        print("Interrupted: stopped at your request.", file=sys.stderr)
        return 130  # 128 + SIGINT
    except Exception as error:  # the last resort: a fault in a file that no reader has seen
        if _is_users(error):
            print(f"phibench: {_sentence(error)}", file=sys.stderr)
            return 1 if _is_incomplete(error) else 2
        if os.environ.get(TRACEBACK):
            raise
        print(f"phibench: {_confession(error)}", file=sys.stderr)
        return 3  # neither done nor the user's fault


class _Stopped(KeyboardInterrupt):
    """SIGTERM or SIGHUP: whatever cleans up after Ctrl-C cleans up after these."""

    def __init__(self, number: signal.Signals) -> None:
        self.number = number


@contextmanager
def _orderly_stop() -> Iterator[None]:
    """SIGTERM and SIGHUP end the command as Ctrl-C does; a second one ends it at once."""
    numbers = [n for n in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) is signal.SIG_DFL]  # nohup ignores one
    if threading.current_thread() is not threading.main_thread():
        numbers = []  # Python hears signals in the main thread alone
    for number in numbers:
        signal.signal(number, _stop)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def _stop(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_DFL)
    raise _Stopped(signal.Signals(number))


def _told(tokens: Sequence[str]) -> AbstractContextManager[object]:
    """Line every 30 s while a command runs that says nothing itself; it is named by its words before the options."""
    from phibench.datasets.common.progress import StillRunning, progress_console

    words = list(takewhile(lambda word: not word.startswith("-"), tokens))
    return StillRunning(progress_console(), f"phibench {' '.join(words[:2])}".rstrip())


TRACEBACK = "PHIBENCH_TRACEBACK"
"""Environment variable; if it is set, a fault of phibench ends in Python's traceback."""


def _refuse_strange(tokens: Sequence[str]) -> None:
    """Refuse arguments that no file can be called, or that no text file can hold."""
    from phibench.datasets.common.errors import DatasetError

    for token in tokens:
        if "\0" in token or any("\ud800" <= c <= "\udfff" for c in token):
            raise DatasetError(f"the argument {token!r} is not UTF-8, or has a zero byte; give another name")


LEAST_ADDRESSES = 800 << 20
"""Bytes of address space; with less, the library of linear algebra asks for memory again and again, or ends."""


def _refuse_little_memory(tokens: Sequence[str]) -> None:
    """Refuse to start where `ulimit -v` leaves too little."""
    if sys.platform == "win32" or not set(tokens) - {"--version", "--help"}:
        return
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if 0 <= limit < LEAST_ADDRESSES:
        raise MemoryError(f"`ulimit -v` allows {limit >> 20} MB of addresses, {LEAST_ADDRESSES >> 20} MB are needed")


def _is_incomplete(error: Exception) -> bool:
    from phibench.datasets.common.errors import IncompleteError

    return isinstance(error, IncompleteError)


def _is_users(error: Exception) -> bool:
    from phibench.benchmark.isolation.run_limits import MethodError
    from phibench.datasets.common.errors import DatasetError
    from phibench.scenes.validation import SceneError

    known = (SceneError, DatasetError, MethodError, OSError, MemoryError)
    # errors of the renderer's own (sensor, variant, LLVM) are sentences too; scoring does not import the renderer
    return isinstance(error, known) or _lacks_memory(error) or type(error).__module__.startswith("phibench.render.")


_NO_MEMORY = ("failed to map segment", "annot allocate memory", "can't start new thread", "out of memory")


def _lacks_memory(error: Exception) -> bool:
    """True if memory or the address space (`ulimit -v`) has ended, also where a library is loaded late."""
    late = isinstance(error, (ImportError, RuntimeError)) and any(words in str(error) for words in _NO_MEMORY)
    return late or isinstance(error, MemoryError)


def _sentence(error: Exception) -> str:
    """Message of an error, which any terminal can show; an operating system's without its number."""
    text = str(error)
    # without the number of the error, which helps nobody
    if isinstance(error, OSError) and error.strerror and type(error).__module__ == "builtins":
        text = f"{error.strerror}: {error.filename}" if error.filename else str(error.strerror)
    if _lacks_memory(error):
        text = f"out of memory; free some, or take less at a time {f'({text})' if text else ''}".rstrip()
    lines = text[:_MOST].splitlines()
    return "\n".join("".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in x) for x in lines)


_MOST = 10_000  # characters of a message: a recipe may have many faults, a line each


def _confession(error: Exception) -> str:
    """Sentence about an error that nobody has thought of: the kind, the message, the place in the code."""
    from phibench.scenes.validation import printable_line

    frames = traceback.extract_tb(error.__traceback__)
    place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
    text = printable_line(f"{type(error).__name__}: {error}", 300)  # an error may quote a whole file
    return (
        f"{text} ({place}). This is a fault of phibench: please report it with the file that you gave; "
        f"{TRACEBACK}=1 shows where"
    )


if __name__ == "__main__":
    sys.exit(main())


OLD_COMMANDS = {
    "new-method": "method new",
    "methods": "method list",
    "check": "method check",
    "dataset seal": "seal make",
    "submit": "seal submit",
    "unseal": "seal open",
    "experiments": "paper --misaligned",
    "panorama": "dataset panorama",
    "sensitivities": "dataset sensitivities",
}
"""New spelling of every command that had another one."""


OLD_OPTIONS = {
    ("score", "--seed"): "--bootstrap-seed",
    ("compare", "--seed"): "--bootstrap-seed",
    ("bench", "--methods"): "--method, once for each method",
    ("dataset frames", "--samples"): "--sample, once for each",
}
"""New spelling of every option that had another one, by command and option."""


OLD_POSITIONS = {("dataset merge", "--out"): "phibench dataset merge SHARD ... --out FOLDER"}
"""Whole new spelling of every command in which an option was a position, by command and option."""


def answer_to_old_spelling(tokens: Sequence[str]) -> str:
    """One sentence with the new spelling of a command line; "" if nothing in it is old."""
    for old, new in OLD_COMMANDS.items():
        if _begins(tokens, old):
            return f"`phibench {old}` is now `phibench {new}`; `phibench {new.split(' --')[0]} --help` has its options"
    given = {token.partition("=")[0] for token in tokens}  # --option=value
    for (command, option), new in OLD_OPTIONS.items():
        if _begins(tokens, command) and option in given:
            return f"`phibench {command} {option}` is now {new}"
    for (command, option), new in OLD_POSITIONS.items():
        if _begins(tokens, command) and not given & {option, "--help", "-h"}:
            return f"`phibench {command}` needs {option}: `{new}`"
    return ""


def _begins(tokens: Sequence[str], command: str) -> bool:
    words = command.split()
    return list(tokens[: len(words)]) == words
