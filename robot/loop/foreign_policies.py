"""Policies of others: the function of a Python file (`PolicyFile`), asked in a process of its own (`PolicyProcess`).

What is known and what is observed go there as pickles of ours. What comes back is JSON: seven numbers, or a sentence.
`serve` runs in the process.
"""

from __future__ import annotations

import ast
import os
import pickle
import secrets
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from phibench.benchmark.isolation.answers import plain_values, to_bytes
from phibench.benchmark.isolation.guest_process import GuestProcess
from phibench.benchmark.isolation.isolation import Isolation
from phibench.benchmark.isolation.method_references import Reference, parsed_file, resolve
from phibench.benchmark.isolation.method_worker import function_of_file, memory_limit, sentence_of, size_bytes
from phibench.benchmark.isolation.pair_transport import Connection, TransportError
from phibench.benchmark.isolation.printed_output import advised_message
from phibench.benchmark.isolation.readable_files import access_of
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.robot.loop.policies import Policy
from phibench.robot.loop.simulator import Action, Known, Observation
from phibench.scenes.validation import SceneError, nearest, printable_line

ANSWER_S = 5.0
"""Time of a policy for one answer."""
_BEGINS = -1  # in place of the number of a step: the policy is made
_MESSAGE_LENGTH = 200  # of a policy's fault: two lines


@dataclass(frozen=True)
class PolicyFile:
    """Function of a Python file that makes a policy of what is known."""

    path: Path
    name: str

    @classmethod
    def of(cls, text: str) -> PolicyFile:
        """From FILE.py:NAME.

        Raises
        ------
        SceneError
            If there is no such file, or no name is given.
        """
        path, _, name = text.rpartition(":")
        if not path.endswith(".py") or not name.isidentifier():
            raise SceneError(
                f"policy '{text}': give FILE.py:NAME, NAME being a function from what is known to a policy"
            )
        if not Path(path).is_file():
            raise SceneError(f"policy '{text}': there is no file {path}; give the path of a Python file")
        if not {name, "*"} & (there := _names(Path(path))):
            raise SceneError(f"policy '{text}': {Path(path).name} has no {name}; {nearest(name, sorted(there))}")
        return cls(Path(path).resolve(), name)

    def reference(self) -> Reference:
        """The file as processes take it, with its hash.

        Raises
        ------
        MethodError
            If it cannot be a module.
        """
        return resolve(f"{self.path}:{self.name}")


def _names(path: Path) -> set[str]:
    """Names that a Python file defines or imports; it is read, not run.

    Raises
    ------
    SceneError
        If it is no Python.
    """
    try:
        tree = parsed_file(path)
    except MethodError as error:
        raise SceneError(f"policy in {error}") from error
    return set(_bound(tree))


def _bound(node: ast.AST) -> Iterator[str]:
    """Names that a module binds wherever it runs a line: in a tuple, a branch or a loop too; "*" of `import *`."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield child.name
        elif isinstance(child, ast.Import | ast.ImportFrom):
            yield from (alias.asname or alias.name.split(".")[0] for alias in child.names)
        elif isinstance(child, ast.Name):
            yield from [child.id] if isinstance(child.ctx, ast.Store) else []
        elif not isinstance(child, ast.Lambda | ast.comprehension):  # names of their own
            yield from _bound(child)


class PolicyProcess:
    """Policy in a process of its own, which is ended when an answer takes too long.

    Parameters
    ----------
    limits : RunLimits
        `seconds` are those of one answer.
    hidden : sequence of Path
        Folders that it cannot read, wherever they lie.

    Raises
    ------
    SceneError
        If the process does not start, the file cannot be imported, or gives no policy.
    """

    def __init__(
        self, file: PolicyFile, known: Known, limits: RunLimits | None = None, hidden: Sequence[Path] = ()
    ) -> None:
        self._limits, self._file, self._closed = limits or RunLimits(seconds=ANSWER_S), str(file.path), False
        try:
            reference = file.reference()
            self._guest = GuestProcess(1, access_of(reference, self._limits, hidden), __name__)
        except MethodError as error:
            raise SceneError(str(error)) from None
        try:
            self.isolation: Isolation = self._guest.load([reference], self._limits)
            self._asked(_BEGINS, known, self._limits.start_seconds, "start")
        except MethodError as error:
            self.close()
            raise SceneError(str(error)) from None
        except BaseException:
            self.close()
            raise

    def act(self, observation: Observation) -> Action:
        """Command of the next step.

        Raises
        ------
        SceneError
            If the policy raised, gave no action, ended its process, or did not answer in time.
        """
        reply = self._asked(observation.step, observation, self._limits.seconds, "answer")
        return _action(reply.get("action"))

    def close(self) -> None:
        """End the process with all that it started."""
        if not self._closed:
            self._closed = True
            self._guest.kill()

    def _asked(self, number: int, content: Known | Observation, seconds: float, what: str) -> dict[str, Any]:
        nonce = secrets.token_hex(8)
        try:
            reply = self._guest.exchange(pickle.dumps((nonce, number, content), protocol=5), nonce, number, seconds)
        except TimeoutError:
            self.close()
            raise SceneError(f"the policy did not {what} within {seconds:g} s: its process was ended") from None
        except TransportError:
            death = self._guest.death(self._file)
            self.close()
            raise SceneError(f"the policy ended its own process: {death}") from None
        if failure := reply.get("failure"):
            text = advised_message(printable_line(str(failure), _MESSAGE_LENGTH), self.isolation)
            raise SceneError(f"the policy raised {text}")
        return reply


def _action(values: object) -> Action:
    """Action of the numbers in a reply, which may be forged; their ranges are the simulator's to check.

    Raises
    ------
    SceneError
        If they are not seven numbers, the whole ones among them whole.
    """
    if not isinstance(values, list) or len(values) != len(Action._fields):
        raise SceneError("the policy answered no Action; give simulator.Action(...)")
    for name, value in zip(Action._fields, values, strict=True):
        whole = isinstance(Action._field_defaults[name], int)
        if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
            kind = "whole number" if whole else "number"
            raise SceneError(f"the policy answered {name} = {printable_line(repr(value), 60)}: a {kind} is needed")
    return Action(*values)


# -- in the process of the policy ------------------------------------------------------------------------------------


def serve(connection: Connection, order: dict[str, Any]) -> None:
    """Import the file of an order, make its policy of what is known, and answer observations until nobody asks."""
    reference = Reference.of(order["references"][0])
    try:
        make = function_of_file(reference)
    except MethodError as error:
        connection.send(to_bytes({"nonce": order["nonce"], "fault": str(error)}))
        return
    most = size_bytes() + int(1e6 * order["memory_mb"])
    connection.send(to_bytes({"nonce": order["nonce"], "fault": ""}))
    policy: Policy | None = None
    process = os.getpid()
    with suppress(TransportError):
        while True:
            nonce, number, content = pickle.loads(connection.receive())
            reply: dict[str, Any] = {"failure": ""}
            try:
                with memory_limit(most):
                    if number == _BEGINS:
                        policy = policy_of(make, content, reference.function)
                    elif policy is not None:
                        reply["action"] = _numbers(policy.act(content))
            except BaseException as error:
                reply = {"failure": sentence_of(error, reference.place)[:_MESSAGE_LENGTH]}
            answer = to_bytes({**reply, "nonce": nonce, "number": number})
            if os.getpid() != process:  # a copy that the policy has forked and let return: one answer is enough
                os._exit(0)
            connection.send(answer)


def policy_of(make: Any, known: Known, name: str) -> Policy:
    """Policy that a function makes of what is known.

    Raises
    ------
    SceneError
        If it is no function, or gives no policy.
    """
    if not callable(make):
        raise SceneError(f"{name} is {type(make).__name__}, no function from what is known to a policy")
    policy = make(known)
    if not callable(getattr(policy, "act", None)):
        raise SceneError(f"{name} gave {type(policy).__name__}, which has no function act(observation)")
    return cast(Policy, policy)


def _numbers(action: Any) -> Any:
    """Numbers of an action as JSON holds them."""
    if not isinstance(action, tuple) or len(action) != len(Action._fields):
        raise SceneError(f"act answered {type(action).__name__}, not an Action; give simulator.Action(...)")
    return plain_values(list(action))
