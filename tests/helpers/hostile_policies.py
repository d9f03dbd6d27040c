"""Policies that try to win without driving, to hang whoever judges them, and to reach what is not theirs."""

HEADER = """
import glob, json, os, pickle, signal, socket, struct, subprocess, sys, time

from phibench.robot.loop.simulator import Action

def line():
    # the socket to whoever judges
    for name in os.listdir("/proc/self/fd"):
        try:
            if os.readlink(f"/proc/self/fd/{name}").startswith("socket:"):
                return int(name)
        except OSError:
            pass

class Policy:
    def __init__(self, act):
        self._act = act

    def act(self, seen):
        return self._act(seen) or Action()
"""

REACHES = """
FILES = {files}

def reaches(seen):
    got = []
    for name in FILES:
        try:
            open(name, "rb").read(1)
            got.append(name)
        except OSError:
            pass
    for pid in (os.getppid(), {judge}):
        for name in ("mem", "environ", "maps"):
            try:
                open(f"/proc/{{pid}}/{{name}}", "rb").read(1)
                got.append(f"/proc/{{pid}}/{{name}}")
            except OSError:
                pass
    for pid in (os.getppid(), {judge}):
        try:
            os.kill(pid, 0 if pid == {judge} else signal.SIGCONT)
            got.append(f"signal to {{pid}}")
        except OSError:
            pass
    for address in (("127.0.0.1", 22), ("127.0.0.1", {port})):
        try:
            socket.create_connection(address, 1.0)
            got.append(str(address))
        except OSError:
            pass
    raise RuntimeError("reached " + json.dumps(got))

def reaching(known):
    return Policy(reaches)
"""
"""All that it reaches stands in what it raises."""

DEEDS = {
    "half a message": (
        'os.write(line(), struct.pack("!Q", 1000) + b"x"); time.sleep(600)',
        "did not answer within",
    ),
    "drops of a message": (
        'os.write(line(), struct.pack("!Q", 10**6))\n    while True:\n        os.write(line(), b" "); time.sleep(0.05)',
        "did not answer within",
    ),
    "a huge message": (
        'os.write(line(), struct.pack("!Q", 1 << 62)); time.sleep(600)',
        "ended its own process",
    ),
    "a pickle": (
        "text = pickle.dumps(Bomb())\n    os.write(line(), struct.pack('!Q', len(text)) + text); time.sleep(600)",
        "did not answer within",
    ),
    "an answer of its own": (
        "text = json.dumps({'failure': '', 'action': [0, 0, 0, 0, 4, 1, 'far'], 'outcome': 'reached'}).encode()\n"
        "    os.write(line(), struct.pack('!Q', len(text)) + text); time.sleep(600)",
        "did not answer within",
    ),
    "a closed line": ("os.close(line()); time.sleep(600)", "did not answer within"),
    "an exit": ("os._exit(3)", "ended its own process"),
    "a daemon": (
        "os.fork() or (os.setsid(), os.fork() and os._exit(0), time.sleep(600))\n    time.sleep(0.5); os._exit(0)",
        "ended its own process",
    ),
    "no action": ("return 'reached'", "not an Action"),
    "wrong numbers": ("return Action(exposure=True)", "exposure = True: a whole number is needed"),
    "memory": ("return bytearray(10**11) and None", "MemoryError"),
}
"""Code of one step, and words of the cause that its episode has."""

BOMB = """
class Bomb:
    def __reduce__(self):
        return (os.system, ("touch {mark}",))
"""


def deeds(mark: object) -> str:
    """Text of a file with a policy for each deed, `deed_0` and so on; `mark` is a file that the pickle would make."""
    made = [
        f"def act_{k}(seen):\n    {code}\n\ndef deed_{k}(known):\n    return Policy(act_{k})\n"
        for k, (code, _) in enumerate(DEEDS.values())
    ]
    return HEADER + BOMB.format(mark=mark) + "\n".join(made)
