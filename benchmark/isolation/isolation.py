"""Isolation of a method's process (`isolate`) on Linux: files it may read (`Access`), by Landlock, seccomp and mounts.

The process reads an `Access` from its standard input and gives up all other rights for good, before it imports the
worker. No thread and no code of the method may come before: Landlock limits the thread that asks for it and what that
thread starts.

Linux 5.13 and later have Landlock, see landlock(7): rules allow folders, the rest is denied. A seccomp filter denies
sockets other than those between a process and its children. Landlock keeps signals within from Linux 6.12 on only, and
never limits: the filter denies signals to the parent, which is the supervisor, and limits (prlimit) of other processes.
Landlock has no rule for permissions, owners, times and attributes of files, nor for watching them, nor for
priorities, cores and processor time of others: the filter denies those calls. Where the system gives a process its
own view of the mounts, all but its folder is read-only there, and hidden folders are empty: they have neither names
nor sizes nor times.

Nothing here needs privileges or imports NumPy. `bwrap` and the package `landlock` were tried: docs/method.md.
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import struct
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

_NOT_LINUX = "only Linux isolates a process"
_NO_LANDLOCK = "this kernel has no Landlock, which Linux has from 5.13 on"


@dataclass(frozen=True)
class Access:
    """Files of a method's process, besides its own folder, the interpreter and the packages.

    Attributes
    ----------
    readable : tuple of str
        Files and folders, absolute.
    hidden : tuple of str
        Never readable, wherever they lie: the data set, and truth that lies near the method.
    fresh : bool
        The process looks at one pair: it gets no memory that outlives it.
    """

    readable: tuple[str, ...] = ()
    hidden: tuple[str, ...] = ()
    fresh: bool = False

    def text(self) -> str:
        """One line of JSON, for the standard input of the process."""
        return json.dumps(asdict(self)) + "\n"

    @classmethod
    def of(cls, text: str) -> Access:
        """From such a line."""
        fields = json.loads(text)
        return cls(tuple(fields["readable"]), tuple(fields["hidden"]), bool(fields["fresh"]))


@dataclass(frozen=True)
class Isolation:
    """Isolation that a process has.

    Attributes
    ----------
    files, network : bool
        Limited to what the method may have; to nothing.
    memory : bool
        /dev/shm is its own or denied, so that nothing in it outlives the process.
    """

    files: bool = False
    network: bool = False
    memory: bool = False
    reason: str = ""

    @property
    def complete(self) -> bool:
        """Neither files of others nor the network can be reached."""
        return self.files and self.network

    def sentence(self) -> str:
        """In words, for a score."""
        if not self.complete:
            return f"not isolated: {self.reason}"
        return "isolated: read its own folder and the packages only, without network"


def isolate(access: Access) -> Isolation:
    """Give up the rights of this process, for good and for all that it starts; the working directory stays its own.

    Where the system cannot do it the process goes on, and the result says why.
    """
    if not sys.platform.startswith("linux"):
        return Isolation(reason=_NOT_LINUX)
    kernel = _Kernel()
    if len(list(Path("/proc/self/task").iterdir())) > 1:
        return Isolation(reason="threads were started before the method")
    own_memory = kernel.own_mounts(Path.cwd(), [Path(path) for path in access.hidden])
    kernel.drop_privileges()
    shared = () if access.fresh and not own_memory else (_SHARED_MEMORY,)
    files = _limit_files(kernel, access, shared)
    network = kernel.filter_calls() or (files and kernel.abi >= _ABI_NETWORK)
    reason = "" if files else _NO_LANDLOCK if kernel.abi < 1 else "the kernel refused the rules"
    if files and not network:
        reason = f"the network is open: no filter for {os.uname().machine}, and this kernel's Landlock has no rule"
    return Isolation(files, network, files and (own_memory or not shared), reason)


# -- files ---------------------------------------------------------------------------------------------------------

_EXECUTE, _WRITE, _READ, _LIST = 1, 2, 4, 8  # LANDLOCK_ACCESS_FS_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_DIR
_DEVICES = 1 << 6 | 1 << 11  # making character and block devices
_TRUNCATE, _IOCTL = 1 << 14, 1 << 15  # LANDLOCK_ACCESS_FS_TRUNCATE, _IOCTL_DEV
_RIGHTS = {1: 13, 2: 14, 3: 15, 5: 16}  # bits of rights to files, by the first ABI that knows them
_ABI_NETWORK, _ABI_SCOPE = 4, 6  # first ABI of Landlock that knows TCP, and scopes
_LOOK = _EXECUTE | _READ | _LIST
_ON_FILES = _EXECUTE | _WRITE | _READ | _TRUNCATE | _IOCTL  # others are refused in the rule of a file
_SHARED_MEMORY = Path("/dev/shm")  # where locks of multiprocessing are

_SYSTEM = """
/usr /lib /lib32 /lib64 /bin /sbin /nix/store /gnu/store /run/opengl-driver
/etc/ld.so.cache /etc/ld.so.conf /etc/ld.so.conf.d /etc/alternatives /etc/fonts /etc/localtime /etc/timezone /etc/passwd
/etc/group /etc/nsswitch.conf /etc/hosts /etc/host.conf /etc/resolv.conf /etc/os-release /etc/mime.types /etc/ssl
/etc/OpenCL /etc/vulkan /etc/glvnd /etc/python3 /etc/locale.alias
/sys/devices /sys/bus /sys/class /sys/module /sys/fs/cgroup /sys/kernel/mm
"""
_PROC = """
/proc/self /proc/cpuinfo /proc/meminfo /proc/stat /proc/version /proc/uptime /proc/loadavg /proc/filesystems /proc/sys
/proc/driver /proc/devices /proc/modules
"""
_DEVICE_FILES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom")
_GPU = ("/dev/dri", "/dev/kfd", "/dev/dxg")  # and /dev/nvidia*


def _limit_files(kernel: _Kernel, access: Access, shared: Sequence[Path]) -> bool:
    """Rules for all that may be read and written; False if the kernel has none."""
    if kernel.abi < 1:
        return False  # a kernel before 5.13
    every = (1 << max(bits for abi, bits in _RIGHTS.items() if abi <= kernel.abi)) - 1
    ruleset = kernel.ruleset(every)
    hidden = [Path(path) for path in access.hidden]
    for name in _PROC.split():
        # /proc makes a new file object when it forgets one, and a rule is about the object: one that is open stays
        kernel.allow(ruleset, Path(name), _LOOK, keep=True)
    readable = [*map(Path, _SYSTEM.split()), *interpreter_paths(), *map(Path, access.readable)]
    for path in set(filter(None, map(_real, dict.fromkeys(readable)))):
        for part, rights in _without(path, hidden):
            kernel.allow(ruleset, part, rights)
    for path in (*map(Path, (*_DEVICE_FILES, *_GPU)), *Path("/dev").glob("nvidia*")):
        kernel.allow(ruleset, path, (_LOOK | _WRITE | _IOCTL) & every)
    for path in (Path.cwd(), *shared):
        kernel.allow(ruleset, path, every & ~_DEVICES)
    return kernel.restrict(ruleset)


def _real(path: Path) -> Path | None:
    """The path without links, if it is there. The kernel says it in a tenth of the time of `Path.resolve`."""
    try:
        handle = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:  # not there: no rule is needed
        return None
    try:
        return Path(f"/proc/self/fd/{handle}").readlink()
    finally:
        os.close(handle)


def _without(path: Path, hidden: Sequence[Path]) -> Iterator[tuple[Path, int]]:
    """Parts of a folder that hold nothing hidden, with their rights; rules cannot take a part out of a whole."""
    if any(path.is_relative_to(other) for other in hidden):
        return  # wholly hidden
    if not any(other.is_relative_to(path) for other in hidden):
        yield path, _LOOK
        return
    yield path, _LIST  # Python imports nothing from a folder that it cannot list
    with suppress(OSError):  # not readable: then not for the method either
        for entry in path.iterdir():
            if not entry.is_symlink():
                yield from _without(entry, hidden)


def interpreter_paths() -> list[Path]:
    """Folders of this interpreter, its packages and its libraries."""
    package, python = sys.modules["phibench"], Path(sys.executable)
    own = {path for path in map(_real, map(Path, package.__path__)) if path}
    paths = [Path(path) for path in (sys.prefix, sys.exec_prefix, sys.base_prefix, sys.base_exec_prefix)]
    paths += [python.parent, (_real(python) or python).parent, *_library_folders()]
    # a checkout holds links to folders beside it
    paths += [entry.resolve() for path in own for entry in (path, *path.iterdir()) if entry.is_dir()]
    paths.append((_real(Path(package.__file__ or python)) or python).parent)
    for path in [Path(path) for path in sys.path if path.startswith("/")]:
        if _real(path) not in own:
            paths.append(path)
        with suppress(OSError):  # not readable
            paths += [Path(entry.path) for entry in os.scandir(path) if entry.is_symlink()]
    for finder in sys.meta_path:  # packages that setuptools installed as editable
        mapping = getattr(sys.modules.get(getattr(finder, "__module__", "")), "MAPPING", {})
        paths += [Path(place) for place in dict(mapping).values()]
    return paths


def _library_folders() -> list[Path]:
    """Folders of shared libraries, by the environment and the linker's settings."""
    lines = os.environ.get("LD_LIBRARY_PATH", "").split(":")
    for file in Path("/etc/ld.so.conf.d").glob("*.conf"):
        with suppress(OSError, ValueError):  # not readable
            lines += file.read_text().splitlines()
    return [Path(line.strip()) for line in lines if line.startswith("/")]


# -- kernel --------------------------------------------------------------------------------------------------------

_CREATE, _ADD, _RESTRICT = 444, 445, 446  # Landlock's system calls, the same on every machine
_BENEATH = 1  # a rule about a path and what is beneath it
_TCP, _SCOPES = 3, 3  # bind and connect; abstract sockets and signals
_SET_NO_NEW_PRIVS, _SET_SECCOMP, _DROP_BOUND = 38, 22, 24  # of prctl(2)
_NEW_USER, _NEW_MOUNTS = 0x10000000, 0x00020000  # CLONE_NEWUSER, CLONE_NEWNS of unshare(2)
_READ_ONLY, _NOSUID_NODEV, _BIND, _REC_PRIVATE = 1, 2 | 4, 4096, 16384 | 1 << 18  # of mount(2)
_MOUNT_SETATTR, _AT_FDCWD, _RECURSIVE = 442, -100, 0x8000  # number of the call; AT_RECURSIVE
_KEPT_CAPABILITIES = 1 << 0 | 1 << 1 | 1 << 3  # of root: owners and permissions of files, within the rules
_CAPABILITIES_3 = 0x20080522  # version of capset(2)


class _Kernel:
    """System calls of Linux that limit this process."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(None, use_errno=True)
        self._call = self._library.syscall
        self._call.restype = ctypes.c_long
        self.abi = int(self._call(_CREATE, None, ctypes.c_size_t(0), 1))  # -1 where there is no Landlock

    def ruleset(self, rights: int) -> int:
        """Set of rules that denies these rights, TCP, and signals to other processes; an open file, or -1."""
        fields = [rights, *([_TCP] if self.abi >= _ABI_NETWORK else []), *([_SCOPES] if self.abi >= _ABI_SCOPE else [])]
        attributes = struct.pack(f"={len(fields)}Q", *fields)
        return int(self._call(_CREATE, attributes, ctypes.c_size_t(len(attributes)), 0))

    def allow(self, ruleset: int, path: Path, rights: int, keep: bool = False) -> None:
        """Allow rights to a file, or to a folder and all in it; no rule for what is not there."""
        try:
            handle = os.open(path, os.O_PATH | os.O_CLOEXEC)
        except OSError:  # gone since it was named
            return
        if not path.is_dir():
            rights &= _ON_FILES
        self._call(_ADD, ruleset, _BENEATH, struct.pack("=Qi", rights, handle), 0)
        if not keep:
            os.close(handle)

    def restrict(self, ruleset: int) -> bool:
        """Enforce a set of rules, for good."""
        self._library.prctl(_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        done = int(self._call(_RESTRICT, ruleset, 0)) == 0
        if ruleset >= 0:
            os.close(ruleset)
        return done

    def own_mounts(self, folder: Path, hidden: Sequence[Path] = ()) -> bool:
        """Mounts of this process alone: an empty /dev/shm, hidden folders empty, all else but a folder read-only.

        A read-only mount keeps times of access, permissions and attributes as they are, by descriptors too.

        Returns
        -------
        bool
            False where the system does not allow a /dev/shm of its own.
        """
        user, group = os.geteuid(), os.getegid()
        if self._library.unshare(_NEW_MOUNTS) != 0:
            if self._library.unshare(_NEW_USER | _NEW_MOUNTS) != 0:
                return False  # neither as root nor in a namespace of its own
            try:
                Path("/proc/self/setgroups").write_text("deny")
                Path("/proc/self/uid_map").write_text(f"{user} {user} 1")
                Path("/proc/self/gid_map").write_text(f"{group} {group} 1")
            except OSError:  # the system gives a process no user namespace
                return False
        self._mount(b"none", Path("/"), None, _REC_PRIVATE)
        shared = self._mount(b"phibench", _SHARED_MEMORY, b"tmpfs", _NOSUID_NODEV, b"mode=1777")
        # a mount of its own, which stays as it is; the two that may be written to are left out of the change
        self._mount(bytes(folder), folder, None, _BIND)
        self._set_read_only(Path("/"), 1, _RECURSIVE)
        for path in (folder, *([_SHARED_MEMORY] if shared else [])):
            self._set_read_only(path, 0)
        os.chdir(folder)  # through the new mount
        for path in hidden:
            # a file is out of reach by its rule, and has a name that this program gave it
            if path.is_dir() and not folder.is_relative_to(path):
                self._mount(b"phibench", path, b"tmpfs", _NOSUID_NODEV | _READ_ONLY, b"mode=755")
        return shared

    def _mount(self, source: bytes, path: Path, kind: bytes | None, flags: int, options: bytes | None = None) -> bool:
        return int(self._library.mount(source, bytes(path), kind, ctypes.c_ulong(flags), options)) == 0

    def _set_read_only(self, path: Path, on: int, flags: int = 0) -> None:
        """Set a mount, or all from a path on, read-only or not; mount_setattr(2), Linux 5.12."""
        attributes = struct.pack("=4Q", on, 1 - on, 0, 0)
        here = ctypes.c_long(_AT_FDCWD)
        self._call(_MOUNT_SETATTR, here, bytes(path), flags, attributes, ctypes.c_size_t(len(attributes)))

    def drop_privileges(self) -> None:
        """Take root's powers off, those of a new user namespace included: rules are for who cannot mount or trace."""
        for capability in range(64):  # a capability set has 64 bits; unknown ones are refused and change nothing
            if not _KEPT_CAPABILITIES >> capability & 1:
                self._library.prctl(_DROP_BOUND, capability, 0, 0, 0)
        kept = _KEPT_CAPABILITIES if os.geteuid() == 0 else 0
        # version 3: twice 32 bits of effective, permitted, inheritable
        self._library.capset(struct.pack("=Ii", _CAPABILITIES_3, 0), struct.pack("=6I", kept, kept, 0, 0, 0, 0))

    def filter_calls(self) -> bool:
        """Deny calls that reach other processes or mark files; False on a machine whose calls are not listed."""
        machine = os.uname().machine
        if machine not in _NUMBERS:
            return False  # numbers of system calls are not known there
        lines = _filter(_NUMBERS[machine], _DENIED[machine], os.getppid())
        program = b"".join(struct.pack("=HBBI", *line) for line in lines)
        buffer = ctypes.create_string_buffer(program, len(program))
        # struct sock_fprog; a line has 8 bytes
        header = struct.pack("@HP", len(program) // 8, ctypes.addressof(buffer))
        self._library.prctl(_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        return int(self._library.prctl(_SET_SECCOMP, 2, header, 0, 0)) == 0  # 2: SECCOMP_MODE_FILTER


# -- system calls that are denied ----------------------------------------------------------------------------------

_ELSEWHERE = {"x86_64": (42, 50, 425, 29, 64, 68, 240), "aarch64": (203, 201, 425, 194, 190, 186, 180)}
"""connect, listen, io_uring_setup, shmget, semget, msgget, mq_open: sockets, and memory that outlives a process."""
_PAST_RULES = {"x86_64": (248, 249, 250, 321, 298, 304, 424), "aarch64": (217, 218, 219, 280, 241, 265, 424)}
"""add_key, request_key, keyctl, bpf, perf_event_open, open_by_handle_at, pidfd_send_signal."""
_MARKS = {
    "x86_64": (
        *(90, 91, 268, 452),  # chmod, fchmod, fchmodat, fchmodat2
        *(92, 93, 94, 260),  # chown, fchown, lchown, fchownat
        *(132, 235, 261, 280),  # utime, utimes, futimesat, utimensat
        *(188, 189, 190, 463, 197, 198, 199, 466, 469),  # (l, f)setxattr(at), (l, f)removexattr(at), file_setattr
        *(253, 294, 254, 300, 301),  # inotify_init, inotify_init1, inotify_add_watch, fanotify_init, fanotify_mark
    ),
    "aarch64": (52, 53, 452, 54, 55, 88, 5, 6, 7, 463, 14, 15, 16, 466, 469, 26, 27, 262, 263),
}
"""What can be done to files that are out of reach, or to one's own to remember a pair by; and watching of files.

By descriptors too: who may read a file may have one, and its owner needs no more to mark it.
"""
_DENIED = {machine: _ELSEWHERE[machine] + _PAST_RULES[machine] + _MARKS[machine] for machine in _MARKS}
_SIGNALS = ("kill", "tkill", "tgkill", "rt_sigqueueinfo", "rt_tgsigqueueinfo")  # to their first argument
_SCHEDULING = ("sched_setparam", "sched_setscheduler", "sched_setaffinity", "sched_setattr")  # of their first argument
_CLOCKS = ("timer_create", "clock_gettime", "clock_nanosleep")
_NUMBERS = {
    "x86_64": {
        **dict(zip(_SIGNALS, (62, 200, 234, 129, 297), strict=True)),
        **{"machine": 0xC000003E, "socket": 41, "socketpair": 53, "sendto": 44},
        **{"prlimit64": 302, "fcntl": 72, "ioctl": 16, "setpriority": 141, "ioprio_set": 251},
        **dict(zip(_SCHEDULING, (142, 144, 203, 314), strict=True)),
        **dict(zip(_CLOCKS, (222, 228, 230), strict=True)),
    },
    "aarch64": {
        **dict(zip(_SIGNALS, (129, 130, 131, 138, 240), strict=True)),
        **{"machine": 0xC00000B7, "socket": 198, "socketpair": 199, "sendto": 206},
        **{"prlimit64": 261, "fcntl": 25, "ioctl": 29, "setpriority": 140, "ioprio_set": 30},
        **dict(zip(_SCHEDULING, (118, 119, 122, 274), strict=True)),
        **dict(zip(_CLOCKS, (107, 113, 115), strict=True)),
    },
}
_LOAD, _EQUAL, _AT_LEAST, _AND, _RETURN = 0x20, 0x15, 0x35, 0x54, 0x06  # of classic BPF: LD W ABS, JEQ, JGE, AND, RET
_ALLOW, _DENY = (0, 0, 0x7FFF0000), (0, 0, 0x00050000 | errno.EACCES)  # SECCOMP_RET_ALLOW, SECCOMP_RET_ERRNO
_NUMBER, _MACHINE, _ARGUMENT = 0, 4, 16  # places in seccomp_data; an argument has 8 bytes, the lower half first
_X32 = 0x40000000  # bit of the numbers of x32, a second table of the same machine
_AF_UNIX, _SOCK_DGRAM, _TYPE = 1, 2, 0xF  # _TYPE: the bits of a socket's type without its flags
_REQUESTS = {
    # F_SETOWN(_EX), F_SETLEASE, F_NOTIFY, F_SET_(FILE_)RW_HINT; FIOSETOWN, SIOCSPGRP
    "fcntl": (8, 15, 1024, 1026, 1036, 1038),
    "ioctl": (0x8901, 0x8902),
}
"""Second arguments that let the kernel signal any process when a file is ready, watch a folder, or mark a file."""
_OF_FILE_SYSTEMS = tuple(kind << 8 for kind in (0x66, 0x76, 0x58, 0x94, 0xF5))
"""Bits 8 to 15 of requests to file systems: flags, versions, attributes and clones, most of them for an owner without
a right to write. "f" and "v" are ext4's and what is common, "X" those of XFS, then those of btrfs and F2FS."""
_Line = tuple[int, int, int, int]


def _filter(numbers: dict[str, int], denied: Sequence[int], supervisor: int) -> list[_Line]:
    """Program of (code, jump if true, jump if false, value) that denies calls with EACCES, see seccomp(2)."""
    deny, allow = (_RETURN, *_DENY), (_RETURN, *_ALLOW)
    lines = [(_LOAD, 0, 0, _MACHINE), (_EQUAL, 1, 0, numbers["machine"]), deny, (_LOAD, 0, 0, _NUMBER)]
    if numbers["machine"] == 0xC000003E:  # AUDIT_ARCH_X86_64
        lines += [(_AT_LEAST, 0, 1, _X32), deny]
    for number in denied:
        lines += [(_EQUAL, 0, 1, number), deny]
    # local sockets that are connected in pairs; a datagram socket could be sent from to any address
    local = [(_LOAD, 0, 0, _ARGUMENT), (_EQUAL, 1, 0, _AF_UNIX), deny]
    local += [(_LOAD, 0, 0, _ARGUMENT + 8), (_AND, 0, 0, _TYPE), (_EQUAL, 0, 1, _SOCK_DGRAM), deny, allow]
    for name in ("socket", "socketpair"):
        lines += [(_EQUAL, 0, len(local), numbers[name]), *local]
    address = _ARGUMENT + 4 * 8  # sendto(socket, buffer, length, flags, address, ...)
    # 64 bits in two halves: both must be 0, so that no address is given
    plain = [line for half in (0, 4) for line in ((_LOAD, 0, 0, address + half), (_EQUAL, 1, 0, 0), deny)]
    lines += [(_EQUAL, 0, len(plain) + 1, numbers["sendto"]), *plain, allow]
    return [*lines, *_outward(numbers, supervisor), allow]


def _outward(numbers: dict[str, int], supervisor: int) -> list[_Line]:
    """Part of the filter about signals to the supervisor, to its group and to all, requests, and others' limits.

    A process number has 32 bits: the kernel ignores the upper half of the argument, and so do these lines.
    """
    deny, allow = (_RETURN, *_DENY), (_RETURN, *_ALLOW)

    def denied(name: str, place: int, values: Sequence[int]) -> list[_Line]:
        """Deny a call if an argument has one of the values."""
        tests = [line for value in values for line in ((_EQUAL, 0, 1, value & 0xFFFFFFFF), deny)]
        body = [(_LOAD, 0, 0, _ARGUMENT + 8 * place), *tests, allow]
        return [(_EQUAL, 0, len(body), numbers[name]), *body]

    lines = [line for name in _SIGNALS for line in denied(name, 0, (supervisor, -os.getpgid(supervisor), -1))]
    lines += _of_other_processes(numbers)
    kinds = [line for kind in _OF_FILE_SYSTEMS for line in ((_EQUAL, 0, 1, kind), deny)]
    # second argument; bits 8 to 15 are the driver's letter
    kinds = [(_LOAD, 0, 0, _ARGUMENT + 8), (_AND, 0, 0, 0xFF00), *kinds]
    lines += [(_EQUAL, 0, len(kinds), numbers["ioctl"]), *kinds, (_LOAD, 0, 0, _NUMBER)]
    for name, requests in _REQUESTS.items():
        lines += denied(name, 1, requests)
    # prlimit(pid, resource, new, old): one's own limits have pid 0
    own = [(_LOAD, 0, 0, _ARGUMENT), (_EQUAL, 0, 1, 0), allow]
    for half in (0, 4):  # limits may be read: there is no pointer to new ones
        own += [(_LOAD, 0, 0, _ARGUMENT + 16 + half), (_EQUAL, 1, 0, 0), deny]
    return [*lines, (_EQUAL, 0, len(own) + 1, numbers["prlimit64"]), *own, allow]


def _of_other_processes(numbers: dict[str, int]) -> list[_Line]:
    """Part of the filter about priorities, cores and processor time of other processes, such as those of the run.

    A process may change its own, by the number 0 or its own; a thread of it only itself. Changes of others would stay
    from pair to pair, and their processor time tells what is being worked on.
    """
    deny, allow, own = (_RETURN, *_DENY), (_RETURN, *_ALLOW), (0, os.getpid())
    lines: list[_Line] = []
    for name in _SCHEDULING:
        body = [(_LOAD, 0, 0, _ARGUMENT), (_EQUAL, 1, 0, own[0]), (_EQUAL, 0, 1, own[1]), allow, deny]
        lines += [(_EQUAL, 0, len(body), numbers[name]), *body]
    for name, of_process in (("setpriority", 0), ("ioprio_set", 1)):  # then the process, as a process and no group
        body = [(_LOAD, 0, 0, _ARGUMENT), (_EQUAL, 1, 0, of_process), deny]
        body += [(_LOAD, 0, 0, _ARGUMENT + 8), (_EQUAL, 1, 0, own[0]), (_EQUAL, 0, 1, own[1]), allow, deny]
        lines += [(_EQUAL, 0, len(body), numbers[name]), *body]
    for name in _CLOCKS:
        # a negative clock is ~process << 3, with 4 for a thread, which must be one of the caller's; above 0 are clocks
        # of the system and the caller's own; 3 in the lowest bits is that of a device
        body = [(_LOAD, 0, 0, _ARGUMENT), (_AT_LEAST, 1, 0, 1 << 31), allow, (_AND, 0, 0, 4), (_EQUAL, 0, 1, 4), allow]
        mine = [(_LOAD, 0, 0, _ARGUMENT), (_AND, 0, 0, 0xFFFFFFF8)]
        mine += [line for pid in own for line in ((_EQUAL, 0, 1, ~pid << 3 & 0xFFFFFFFF), allow)]
        lines += [(_EQUAL, 0, len(body) + len(mine) + 1, numbers[name]), *body, *mine, deny]
    return lines


def isolated_by(stream: TextIO) -> dict[str, Any]:
    """Isolate this process by the line of `Access.text` in its standard input; the fields of its `Isolation`."""
    access = Access.of(stream.readline())
    os.dup2(os.open(os.devnull, os.O_RDONLY), stream.fileno())
    isolation = isolate(access)
    if sys.version_info >= (3, 14):  # its start method, a server of processes, is reached by a socket
        import multiprocessing

        multiprocessing.set_start_method("fork")
    return asdict(isolation)
