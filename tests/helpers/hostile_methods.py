"""Hostile methods: what a method may do to its answer, its messages, its process, the channel and the machine.

Each is honest but for pair `BAD`. Lines see `pair`, `Answer`, `Spot`, `np` and the modules that `HEADER` names.
"""

from __future__ import annotations

from dataclasses import dataclass

from helpers.sandbox_pairs import GOOD
from helpers.sandbox_pairs import HEADER as NAMES

BAD = 1
DENIED = ("error", "crash")  # the first where the system denies signals to the supervisor
HEADER = f"""{NAMES}import ctypes, gc, json, os, resource, signal, socket, struct, subprocess, sys, threading, time
from pathlib import Path
X = Spot.missing('not looked for')
def opened(word):
    for n in range(3, 64):
        try:
            if word in os.readlink(f'/proc/self/fd/{{n}}'): return n
        except OSError: pass
LINE, MEMORY = opened('socket:'), opened('phibench-pair')
def say(text):
    data = text if isinstance(text, bytes) else text.encode()
    os.write(LINE, struct.pack('!Q', len(data)) + data)
def nonce():
    frame = sys._getframe()
    while frame is not None:
        if 'received' in frame.f_locals:
            return frame.f_locals['received'].nonce
        frame = frame.f_back
def daemon(seconds=60):
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            time.sleep(seconds)
        os._exit(0)
"""


@dataclass(frozen=True)
class Hostile:
    """A hostile method.

    Attributes
    ----------
    deed : lines of Python
        Done for pair `BAD`.
    failures : tuple of str
        Failures that pair `BAD` may have; "" is an answer.
    lasting : bool
        It breaks its own process for what comes after: the other pairs may fail, too, but must be answered for.
    """

    deed: str
    failures: tuple[str, ...]
    lasting: bool = False

    def body(self) -> str:
        """Body of `extract`."""
        lines = "\n".join(f"    {line}" for line in self.deed.strip().splitlines())
        return f"if pair.number == {BAD}:\n{lines}\nreturn {GOOD}"


def _spot(arguments: str) -> Hostile:
    return Hostile(f"return Answer(Spot({arguments}), X)", ("invalid",))


def _status(text: str) -> Hostile:
    return Hostile(f"return Answer(Spot.missing({text}), X)", ("",))


def _raised(lines: str, *failures: str) -> Hostile:
    return Hostile(lines, failures or ("error",))


def _class(lines: str, used: str, *failures: str) -> Hostile:
    """A deed that needs a class of its own."""
    return Hostile(f"{lines}\nreturn {used}", failures or ("invalid", "error"))


HUGE = "10**400"
OBSCURE = "'[/path] [red]\\x1b[2J\\ud800 $\\\\frac{1}$ <script>\\u202e\\x00'"

ANSWERS: dict[str, Hostile] = {
    "a list for a convention": _spot("(1., 2.), phi_rad=0.1, phi_convention=['ray']"),
    "a dict for a convention": _spot("(1., 2.), phi_rad=0.1, phi_convention={'ray': 1}"),
    "a set for a convention": _spot("(1., 2.), phi_rad=0.1, phi_convention={'ray'}"),
    "markup for a convention": _spot(f"(1., 2.), phi_rad=0.1, phi_convention={OBSCURE}"),
    "a huge integer for u": _spot(f"({HUGE}, 2)"),
    "a huger integer for v": _spot("(1, -10**6000)"),
    "a huge integer for phi": _spot(f"(1., 2.), phi_rad={HUGE}"),
    "a huge integer in a covariance": _spot(f"(1., 2.), (({HUGE}, 0), (0, 1))"),
    "a huge integer for D": Hostile(f"return Answer(X, X, {HUGE})", ("invalid",)),
    "a huge integer for sigma": Hostile(f"return Answer(X, X, 1, {HUGE})", ("invalid",)),
    "a diverged position": _spot("(1.7e308, -1.7e308)"),
    "a diverged covariance": _spot("(1., 2.), ((1.7e308, 0.), (0., 1.7e308))"),
    "a diverged off-diagonal": _spot("(1., 2.), ((1., 1.7e308), (1.7e308, 1.))"),
    "a diverged phi": _spot("(1., 2.), phi_rad=1.7e308"),
    "a diverged D": Hostile("return Answer(X, X, 1.7e308, 1.7e308)", ("invalid",)),
    "the least float for D": Hostile("return Answer(X, X, 5e-324)", ("invalid",)),
    "the least float for sigma": Hostile("return Answer(X, X, 1., 5e-324)", ("invalid",)),
    "the least float for a variance": _spot("(1., 2.), ((5e-324, 0.), (0., 5e-324))"),
    "a covariance that is a line": _spot("(1., 2.), ((1., 1.), (1., 1. + 1e-15))"),
    "NaN everywhere": _spot("(np.nan, np.nan), ((np.nan,) * 2,) * 2, np.nan"),
    "infinities": _spot("(np.inf, -np.inf)"),
    "a longdouble beyond floats": _spot("(np.longdouble('1e4000'), 1.)"),
    "complex numbers": _spot("(1j, 2j)"),
    "a complex array": _spot("np.array([1 + 1j, 2.])"),
    "dates": _spot("np.array(['2020-01-01', '2021-01-01'], 'datetime64[D]')"),
    "an array of objects": _spot("np.array([{}, []], object)"),
    "a structured array": _spot("np.zeros(1, [('u', float), ('v', float)])"),
    "a list that holds itself": Hostile("x = [1.]\nx.append(x)\nreturn Answer(Spot(x), X)", ("invalid",)),
    "a deep list": Hostile(
        "x = 1.\nfor _ in range(900): x = [x, x]\nreturn Answer(Spot((x, x)), X)", ("invalid", "error", "timeout")
    ),
    "a million numbers": _spot("[1.] * 1_000_000"),
    "bytes": _spot("b'12'"),
    "truths": _spot("(True, False)"),
    "modules and types": Hostile("return Answer(Spot, sys)", ("invalid",)),
    "a status that is a list": _spot("(1., 2.), status=['ok']"),
    "an empty status": _spot("(1., 2.), status=' \\n'"),
    "ok between blanks, without a position": _spot("None, status=' ok\\n'"),
    "markup, escapes and a surrogate for a status": _status(OBSCURE),
    "ten megabytes for a status": _status("'x' * 10_000_000"),
    "ten thousand lines for a status": _status("'x\\n' * 10_000"),
    "a status that is a subclass of str": _class(
        "class S(str):\n    def __getitem__(self, k): return 7\n    def __str__(self): raise OSError('no')",
        "Answer(Spot.missing(S('x')), X)",
        "invalid",
        "error",
        "",
    ),
    "an array that raises": _class(
        "class A:\n    def __array__(self, *a, **k): raise SystemExit('array')", "Answer(Spot(A()), X)"
    ),
    "a shape that raises": _class(
        "class A:\n    @property\n    def shape(self): raise KeyboardInterrupt", "Answer(Spot(A()), X)"
    ),
    "a list of itself": _class("class A:\n    def tolist(self): return [self, self]", "Answer(Spot(A()), X)"),
    "an array that says it is small": _class(
        "class A:\n    shape = (2,)\n    def tolist(self): return [1.] * 10_000_000", "Answer(Spot(A()), X)", "invalid"
    ),
    "floats that are no floats": _class(
        "class F(float):\n    def __float__(self): raise ValueError('f')\n    __repr__ = __str__ = __float__",
        "Answer(Spot((F(1), F(2))), X)",
        "",
        "invalid",
        "error",
    ),
    "integers that lie about their size": _class(
        "class I(int):\n    def __abs__(self): return 0\n    def bit_length(self): return 'x'",
        f"Answer(Spot((I({HUGE}), 1)), X)",
    ),
    "an answer of another class": _class(
        "class A(Answer):\n    @property\n    def down(self): return None", "object.__new__(A)", "invalid", "error"
    ),
    "fields that are not there": Hostile("return object.__new__(Answer)", ("error", "invalid")),
    "a name that is markup": _class("A = type('[/b]\\x1b[2J' + 'x' * 5000, (), {})", "A()", "invalid"),
    "a generator": Hostile("return (x for x in [1])", ("invalid",)),
    "a document of its own": Hostile("return {'wrong': 3, 'failure': ['x']}", ("invalid",)),
}

MESSAGES: dict[str, Hostile] = {
    "markup, escapes and a surrogate": _raised(f"raise ValueError({OBSCURE})"),
    "a path in brackets": _raised("raise OSError(2, 'no', '[/path]')"),
    "ten megabytes": _raised("raise ValueError('x' * 10_000_000)"),
    "an exception that raises": _raised(
        "class E(Exception):\n    def __str__(self): raise ValueError('no')\nraise E('x')"
    ),
    "an exception that says a number": _raised("class E(Exception):\n    def __str__(self): return 3\nraise E"),
    "an exception with a strange name": _raised(
        f"raise type({OBSCURE.replace(chr(92) + 'x00', '')}, (Exception,), {{}})"
    ),
    "Ctrl-C": _raised("raise KeyboardInterrupt"),
    "the end of a generator": _raised("raise GeneratorExit"),
    "an exit with an object": _raised("sys.exit([1, 2])"),
    "an exception group, deep": _raised(
        "e = ValueError('x')\nfor _ in range(900): e = ExceptionGroup('g', [e])\nraise e"
    ),
    "causes in a circle": _raised("a, b = ValueError('a'), ValueError('b')\na.__cause__ = b\nb.__cause__ = a\nraise a"),
    "recursion without end": _raised("def f(): return f()\nf()"),
    "prints escapes and halves of letters": Hostile(
        f"os.write(1, b'\\xff\\xfe\\x00\\x1b]0;x\\x07[/red]\\n')\nprint({OBSCURE})", ("error",)
    ),
    "prints without end": Hostile("while True: os.write(1, b'x' * 65536)", ("timeout",)),
    "prints a stack that is none": Hostile(
        "os.write(2, b'Fatal Python error: x\\n(most recent call first)\\n  File \"[/x]\\x1b[2J\", line 9 in f\\n')\n"
        "os._exit(1)",
        ("crash",),
    ),
}

PROCESS: dict[str, Hostile] = {
    "leaves with 0": Hostile("os._exit(0)", ("crash",)),
    "aborts": Hostile("os.abort()", ("crash",)),
    "a real-time signal": Hostile("os.kill(os.getpid(), 40)\ntime.sleep(9)", ("crash",)),
    "the last real-time signal": Hostile("os.kill(os.getpid(), signal.SIGRTMAX)\ntime.sleep(9)", ("crash",)),
    "kills itself": Hostile("os.kill(os.getpid(), 9)", ("crash",)),
    "kills its group": Hostile("os.killpg(0, 9)", ("crash",)),
    "stops itself": Hostile("os.kill(os.getpid(), signal.SIGSTOP)", ("timeout",)),
    "kills its supervisor": Hostile("os.kill(os.getppid(), 9)\ntime.sleep(9)", DENIED),
    "kills its supervisor and lives on": Hostile(
        "ctypes.CDLL(None).prctl(1, 0, 0, 0, 0)\ndaemon()\nos.kill(os.getppid(), 9)\ntime.sleep(60)",
        (*DENIED, "timeout"),
    ),
    "stops its supervisor": Hostile("os.kill(os.getppid(), signal.SIGSTOP)\nos._exit(1)", (*DENIED, "timeout")),
    "ignores every signal, in C": Hostile(
        "for n in range(1, 65):\n    try: signal.signal(n, signal.SIG_IGN)\n    except (OSError, ValueError): pass\n"
        "ctypes.PyDLL(None).sleep(60)",
        ("timeout",),
    ),
    "a stack without end, in C": Hostile(
        "sys.setrecursionlimit(10**9)\ndef f(): return [*map(lambda _: f(), [0])]\nf()",
        ("crash", "error", "memory", "timeout"),
    ),
    "a fault without a stack": Hostile("import faulthandler\nfaulthandler.disable()\nctypes.string_at(0)", ("crash",)),
    "an alarm for later": Hostile("signal.setitimer(signal.ITIMER_REAL, 0.05)", ("", "crash"), lasting=True),
    "no processor time": Hostile("resource.setrlimit(resource.RLIMIT_CPU, (1, 1))\nwhile True: pass", ("crash",)),
    "no files": Hostile("resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))", ("", "crash", "error"), lasting=True),
    "no address space": Hostile("resource.setrlimit(resource.RLIMIT_AS, (1, 1))\nbytes(10**9)", ("memory", "crash")),
    "another program": Hostile("os.execv('/bin/sleep', ['sleep', '60'])", ("timeout", "crash")),
    "another program that ends": Hostile("os.execv('/bin/true', ['true'])", ("crash",)),
    "no standard output": Hostile("sys.stdout = sys.stderr = None", ("", "error")),
    "a standard output that raises": Hostile(
        "class S:\n    def flush(self): raise KeyboardInterrupt\nsys.stdout = S()", ("", "crash"), lasting=True
    ),
    "closed streams": Hostile("os.close(1); os.close(2)", ("",)),
    "a clock that runs backwards": Hostile(
        "time.perf_counter = time.monotonic = time.time = lambda: -1967.0", ("", "error")
    ),
    "no built-in functions": Hostile("import builtins\nbuiltins.isinstance = None", ("crash", "error"), lasting=True),
    "NumPy without arrays": Hostile("np.array_equal = np.frombuffer = None", ("crash",), lasting=True),
    "no modules": Hostile("sys.modules.clear()", ("", "crash", "error"), lasting=True),
    "another number in the pair": Hostile("object.__setattr__(pair, 'number', 99)", ("",)),
    "an exit that hangs": Hostile("import atexit\natexit.register(time.sleep, 60)\nsys.exit()", ("error",)),
    "a thread that does not end": Hostile("threading.Thread(target=time.sleep, args=(60,)).start()", ("",)),
    "a thread that exits later": Hostile(
        "threading.Thread(target=lambda: (time.sleep(0.3), os._exit(5))).start()", ("",), lasting=True
    ),
    "a copy that answers, too": Hostile("os.fork()", ("",)),
    "a copy that answers later": Hostile("if os.fork() == 0: time.sleep(0.2)", ("",)),
    "a copy that answers for the method": Hostile("if os.fork() != 0: time.sleep(60)", ("timeout",)),
    "a copy that stays": Hostile("if os.fork() == 0: time.sleep(60)", ("",)),
    "a daemon of its own session": Hostile("daemon()", ("",)),
    "a daemon that holds everything": Hostile("daemon()\nos._exit(7)", ("crash",)),
    "a daemon that ignores signals": Hostile(
        "for n in (1, 2, 15): signal.signal(n, signal.SIG_IGN)\ndaemon()\n1 / 0", ("error",)
    ),
    "thirty children": Hostile("for _ in range(30): subprocess.Popen(['sleep', '60'], start_new_session=True)", ("",)),
    "a chain of children": Hostile(
        "if os.fork() == 0:\n    end = time.monotonic() + 60\n    while time.monotonic() < end:\n"
        "        if os.fork(): os._exit(0)\n    os._exit(0)",
        ("",),
    ),
    "a hundred chains of children, each of its own session": Hostile(
        "for _ in range(100):\n    if os.fork() == 0:\n        os.setsid()\n        end = time.monotonic() + 20\n"
        "        while time.monotonic() < end:\n            if os.fork(): os._exit(0)\n        os._exit(0)",
        ("", "timeout"),
    ),
    "a daemon without environment": Hostile(
        "subprocess.Popen(['/bin/sh', '-c', 'setsid sleep 60 & exit'], env={}, cwd='/')\ntime.sleep(0.2)", ("",)
    ),
}

CHANNEL: dict[str, Hostile] = {
    "ten forged replies": Hostile(
        "for _ in range(10): say(json.dumps({'failure': '', 'seconds': -1967.0, 'answer': {}}))", ("",)
    ),
    "ten replies that are not JSON": Hostile("for _ in range(10): say(b'\\xff{')", ("",)),
    "a hundred forged replies": Hostile("for _ in range(100): say('{}')", ("crash",)),
    "ten replies with the right nonce": Hostile(
        "reply = {'failure': ['x'], 'nonce': nonce(), 'number': pair.number, 'seconds': 'x'}\n"
        "for _ in range(10): say(json.dumps(reply))",
        ("invalid",),
    ),
    "a failure that there is not": Hostile(
        "say(json.dumps({'failure': 'won', 'message': 3, 'nonce': nonce(), 'number': pair.number}))\ntime.sleep(1)",
        ("invalid",),
    ),
    "a failure whose message is a list": Hostile(
        "say(json.dumps({'failure': 'error', 'message': [3], 'nonce': nonce(), 'number': pair.number}))\ntime.sleep(1)",
        ("invalid",),
    ),
    "an answer that is a number": Hostile(
        "say(json.dumps({'failure': '', 'answer': 3, 'nonce': nonce(), 'number': pair.number}))\ntime.sleep(1)",
        ("invalid",),
    ),
    "an answer whose spots are lists": Hostile(
        "say(json.dumps({'failure': '', 'answer': {'down': [], 'up': {}}, 'nonce': nonce(), 'number': pair.number}))\n"
        "time.sleep(1)",
        ("invalid",),
    ),
    "an answer with huge integers": Hostile(
        "d = {'status': 'ok', 'uv_px': [10**400, 1], 'phi_rad': None}\n"
        "d |= {'phi_convention': 'ray', 'covariance_px2': None}\n"
        "say(json.dumps({'failure': '', 'answer': {'down': d, 'up': d, 'depth_m': None, 'sigma_depth_m': None},"
        " 'nonce': nonce(), 'number': pair.number}))\ntime.sleep(1)",
        ("invalid",),
    ),
    "brackets without end": Hostile("say('[' * 500_000)", ("",)),
    "an integer of a million digits": Hostile("say('9' * 900_000)", ("",)),
    "too long a reply": Hostile("os.write(LINE, struct.pack('!Q', 1 << 40))", ("crash",)),
    "a reply in two halves": Hostile("os.write(LINE, struct.pack('!Q', 100) + b'x')\ntime.sleep(60)", ("timeout",)),
    "the reply of the pair before": Hostile(
        "say(json.dumps({'failure': 'error', 'message': 'x', 'number': 0}))", ("",)
    ),
    "a closed channel": Hostile("os.close(LINE)", ("crash",)),
    "a channel that is shut": Hostile("socket.socket(fileno=LINE).shutdown(2)", ("crash",)),
    "every file closed": Hostile("os.closerange(0, 256)", ("crash", "error")),
    "a channel that somebody else reads": Hostile(
        "s = socket.socket(fileno=os.dup(LINE))\nthreading.Thread(target=s.recv, args=(4096,), daemon=True).start()",
        ("",),
        lasting=True,
    ),
    "memory that is cut short": Hostile(
        "f = os.open(f'/proc/self/fd/{MEMORY}', os.O_RDWR)\nos.ftruncate(f, 0)", ("error",)
    ),
    "memory that grows": Hostile(
        "f = os.open(f'/proc/self/fd/{MEMORY}', os.O_RDWR)\nos.ftruncate(f, 1 << 40)", ("error",)
    ),
    "memory that is written": Hostile(
        "f = os.open(f'/proc/self/fd/{MEMORY}', os.O_RDWR)\nos.pwrite(f, b'x' * 64, 0)", ("error",)
    ),
    "memory that is mapped for writing": Hostile(
        "import mmap\nmmap.mmap(os.open(f'/proc/self/fd/{MEMORY}', os.O_RDWR), 4096)[0] = 1", ("error",)
    ),
    "memory that is closed": Hostile("os.close(MEMORY)", ("", "crash"), lasting=True),
}

FOLDER: dict[str, Hostile] = {
    "3000 folders in each other": Hostile(
        "for _ in range(3000):\n    os.mkdir('d')\n    os.chdir('d')\nos.chdir('/')", ("",)
    ),
    "3000 folders, closed ones": Hostile(
        "for _ in range(300):\n    os.mkdir('d')\n    os.chdir('d')\nfor _ in range(300):\n    os.chmod('.', 0)\n"
        "    os.chdir('..')",
        ("", "error"),
    ),
    "wide and deep": Hostile(
        "for a in range(20):\n    for b in range(20): os.makedirs(f'{a}/{b}/c')\n    open(f'{a}/f', 'w').close()", ("",)
    ),
    "no folder any more": Hostile("os.rmdir(os.getcwd())", ("", "error")),
    "a folder that is a link": Hostile(
        "here = os.getcwd()\nos.chdir('/')\nos.rmdir(here)\nos.symlink(os.path.dirname(here) + '/precious', here)",
        ("", "error"),
    ),
    "links to what is precious": Hostile(
        "os.symlink('../precious', 'a')\nos.symlink('/', 'b')\nos.symlink('c', 'c')", ("",)
    ),
    "pipes, sockets and strange names": Hostile(
        "os.mkfifo('p')\ns = socket.socket(socket.AF_UNIX)\ns.bind('s')\n"
        "os.mkdir(b'\\xff\\xfe')\nopen(b'\\xff\\xfe/\\n', 'w').close()",
        ("",),
    ),
    "five thousand files": Hostile("for i in range(5000): os.close(os.open(f'f{i}', os.O_CREAT))", ("",)),
    "a folder that nobody may write": Hostile(
        "os.mkdir('a')\nopen('a/b', 'w').close()\nos.chmod('a', 0)\nos.chmod('.', 0)", ("", "error")
    ),
}

ALL: dict[str, Hostile] = {
    f"{group}: {name}": hostile
    for group, named in (
        ("answer", ANSWERS),
        ("message", MESSAGES),
        ("process", PROCESS),
        ("channel", CHANNEL),
        ("folder", FOLDER),
    )
    for name, hostile in named.items()
}
