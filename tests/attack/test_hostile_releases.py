"""Servers and releases that hold a fetch up, fill memory or disk, lead astray, or contradict themselves."""

from __future__ import annotations

import gzip
import json
import os
import tarfile
import time
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.strange_releases import (
    TITLE,
    Say,
    digest,
    file_answer,
    member,
    packed,
    strange_server,
    tiny_release,
    trickle,
)

from phibench.benchmark.release.fetch import fetch
from phibench.benchmark.release.paced_http import Patience
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError

SOON = Patience(answer_s=0.4, document_s=0.4, window_s=0.4)
MIB = 1 << 20


def told(source: Path | str, out: Path, **options: Any) -> str:
    """The sentence that ends a fetch; nothing has its final name."""
    with pytest.raises(DatasetError) as caught:
        fetch("tiny", out, str(source), tries=1, **{"patience": SOON, **options})
    assert not out.exists()
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) < 1000
    return message


def test_a_tiny_release_is_fetched(tmp_path: Path) -> None:
    release = tiny_release(tmp_path / "release")
    assert fetch("tiny", tmp_path / "a", str(release)).fetched == 1
    answer = lambda path, say: say(file_answer((release / path[1:]).read_bytes()))  # noqa: E731
    with strange_server(answer) as address:
        assert fetch("tiny", tmp_path / "b", address, patience=SOON).fetched == 1
    assert (tmp_path / "b" / "frames" / "a.png").read_bytes() == b"a picture"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "release"]


# -- answers that never end ------------------------------------------------------------------------------------------

HEADER = b"HTTP/1.1 200 OK\r\n"
CHUNKED = HEADER + b"Transfer-Encoding: chunked\r\n\r\n"
ENDLESS: dict[str, tuple[Callable[[Say], None], str]] = {
    "silence": (lambda say: trickle(say, b""), "takes too long to begin its answer"),
    "a letter of the headers at a time": (lambda say: trickle(say, b"H"), "takes too long to begin its answer"),
    "headers, slowly": (lambda say: (say(HEADER), trickle(say, b"a: b\r\n"))[1], "takes too long to begin"),
    "continue, slowly": (lambda say: trickle(say, b"HTTP/1.1 100 Continue\r\n\r\n"), "takes too long to begin"),
    "continue, fast": (
        lambda say: trickle(say, b"HTTP/1.1 100 Continue\r\n\r\n" * 1000, 0.0),
        "sends headers without end",
    ),
    "a body, slowly": (lambda say: (say(HEADER + b"\r\n"), trickle(say, b" "))[1], "sends its file too slowly"),
    "a chunk's length, slowly": (lambda say: (say(CHUNKED), trickle(say, b"0"))[1], "sends its file too slowly"),
    "a trailer, fast": (
        lambda say: (say(CHUNKED + b"1\r\n{\r\n0\r\n"), trickle(say, b"a: b\r\n" * 1000, 0.0))[1],
        "sends more than the file has",
    ),
}


@pytest.mark.parametrize("name", ENDLESS)
def test_a_server_holds_a_fetch_for_no_longer_than_it_may(name: str, tmp_path: Path) -> None:
    """Time is that of the server: it says something every 20 ms, or as fast as it can, and counts."""
    (answer, words), said = ENDLESS[name], list[int]()

    def counted(say: Say) -> Say:
        return lambda data: (said.append(len(data)), say(data))[1]

    with strange_server(lambda path, say: answer(counted(say))) as address:
        message = told(address, tmp_path / "set")
        if name.endswith("fast"):  # what a quarter of a megabyte may be, and what the system's buffers hold
            assert sum(said) < 16 * MIB
        else:
            assert len(said) < 10 * SOON.answer_s / 0.02  # ten times what it is allowed
    assert words in message


def test_an_archive_comes_at_a_least_rate(tmp_path: Path) -> None:
    """Slow and steady is enough above the rate, however long the whole takes; below it the fetch ends."""
    release = tiny_release(tmp_path / "release")
    archive = (release / f"{TITLE}-000.tar").read_bytes()
    step = 0.05

    def answer(path: str, say: Say) -> None:
        data = (release / path[1:]).read_bytes()
        if not path.endswith(".tar"):
            say(file_answer(data))
            return
        say(file_answer(data)[: -len(data)])
        for start in range(0, len(data), pieces):
            time.sleep(step)
            say(data[start : start + pieces])

    patience = Patience(window_s=0.4, least_bytes_per_s=1000)
    with strange_server(answer) as address:
        pieces = 10  # 200 bytes a second
        assert "sends its file too slowly" in told(address, tmp_path / "set", patience=patience)
        pieces = 1000  # 20 000 a second: the whole takes longer than a window
        assert len(archive) / pieces * step > 0.4
        assert fetch("tiny", tmp_path / "set", address, patience=patience).fetched == 1


# -- bytes without bound ---------------------------------------------------------------------------------------------


def peak(function: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def bomb(layers: int = 1) -> bytes:
    """200 MiB of blanks in 200 KiB."""
    packer = zlib.compressobj(9, wbits=31)
    data = b"".join(packer.compress(b" " * MIB) for _ in range(200)) + packer.flush()
    return data if layers == 1 else gzip.compress(data)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (lambda: HEADER + b"\r\n" + b" " * (20 * MIB), "has more than 1048576 bytes"),
        (lambda: file_answer(bomb(), "Content-Encoding: gzip"), "has more than 1048576 bytes"),
        (lambda: file_answer(bomb(2), "Content-Encoding: gzip, gzip"), "packs its files as 'gzip, gzip'"),
        (lambda: file_answer(b"x" * 99, "Content-Encoding: gzip"), "broke off|does not answer"),
        (lambda: file_answer(gzip.compress(b"{}")[:-4], "Content-Encoding: gzip"), "broke off|does not answer"),
    ],
    ids=["endless", "gzip", "gzip in gzip", "no gzip", "half a gzip"],
)
def test_a_manifest_of_any_size_takes_little_memory(answer: Callable[[], bytes], words: str, tmp_path: Path) -> None:
    data = answer()
    with strange_server(lambda path, say: say(data)) as address:
        messages: list[str] = []
        used = peak(lambda: messages.append(told(address, tmp_path / "set", patience=Patience())))
    assert any(word in messages[0] for word in words.split("|")), messages[0]
    assert used < 16 * MIB  # the manifest's bound, buffers, and modules that are loaded first here


def test_a_folder_has_the_same_bounds(tmp_path: Path) -> None:
    release = tiny_release(tmp_path / "release")
    archive = release / f"{TITLE}-000.tar"
    archive.write_bytes(archive.read_bytes() + b"0" * 2048)
    assert "is damaged" in told(release, tmp_path / "set")
    archive.unlink()
    os.mkfifo(archive)
    assert "no ordinary file" in told(release, tmp_path / "set")
    archive.unlink()
    archive.symlink_to("/dev/zero")
    assert "no ordinary file" in told(release, tmp_path / "set")
    with (release / "MANIFEST.json").open("wb") as file:
        file.truncate(1 << 40)  # takes no room on the disk
    assert "at most 1048576 are read" in told(release, tmp_path / "set")
    (release / "MANIFEST.json").unlink()
    (release / "MANIFEST.json").mkdir()
    with pytest.raises((DatasetError, OSError)):
        fetch("tiny", tmp_path / "set", str(release))


# -- addresses -------------------------------------------------------------------------------------------------------

ODD = (
    *("http://", "https:///x", "http:/127.0.0.1/x", "http:127.0.0.1", "http://[", "http://[::1", "http://[abc]/x"),
    *("http://127.0.0.1:99999", "http://127.0.0.1:x", "http://.example.invalid", "http://a..b.invalid/"),
    *(f"http://{'a' * 70}.invalid", "http://ä\u200d.invalid", "http://%00", "http://127.0.0.1:9/?a=b", "ftp://x/y"),
    *("http://127.0.0.1:9/#a", "http://a b/", "http://*", "HTTP://127.0.0.1:9", "http://127.0.0.1:0", "//x/y"),
)


@pytest.mark.parametrize("address", ODD)
def test_an_odd_address_ends_in_a_sentence(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fetch", "dev", "--out", str(tmp_path / "set"), "--from", address]) == 2
    err = capsys.readouterr().err
    assert "fault of phibench" not in err
    assert err.startswith("phibench: ")


TARGETS = (
    *("http://[", "http://[::1", "ftp://127.0.0.1/x", "file:///etc/passwd", "http://", "http://a..b.invalid/"),
    *("http://127.0.0.1:99999/", "gopher://x", "http://.invalid", "\x80\xff", "http://%zz/", f"http://{'a' * 70}.b/"),
)


@pytest.mark.parametrize("target", TARGETS)
def test_an_odd_redirect_ends_in_a_sentence(target: str, tmp_path: Path) -> None:
    head = b"HTTP/1.1 302 Found\r\nContent-Length: 0\r\nConnection: close\r\nLocation: "
    with strange_server(lambda path, say: say(head + target.encode("latin-1") + b"\r\n\r\n")) as address:
        assert told(address, tmp_path / "set")


def test_redirects_are_followed_and_counted(tmp_path: Path) -> None:
    release = tiny_release(tmp_path / "release")
    head = "HTTP/1.1 302 Found\r\nContent-Length: 0\r\nConnection: close\r\nLocation: {}\r\n\r\n"

    def answer(path: str, say: Say) -> None:
        say(
            head.format(f"/moved{path}").encode()
            if not path.startswith("/moved")
            else file_answer((release / path[len("/moved/") :]).read_bytes())
        )

    with strange_server(answer) as address:
        assert fetch("tiny", tmp_path / "set", address).fetched == 1
    with strange_server(lambda path, say: say(head.format(path + "a").encode())) as address:
        assert "leads from address to address" in told(address, tmp_path / "other")


@pytest.mark.parametrize(
    "place",
    [
        "http://user:s3cret@127.0.0.1:9/x",
        "http://user:s3cret@127.0.0.1:s3cret/x",
        "http://user:s3cret@[/x",
        "http:user:s3cret@127.0.0.1/x",
        "ftp://user:s3cret@127.0.0.1/x",
        "user:s3cret@127.0.0.1/x",
        "http://127.0.0.1:9/x?token=s3cret",
    ],
)
def test_no_password_of_an_address_is_printed(place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fetch", "dev", "--out", str(tmp_path / "set"), "--from", place]) == 2
    assert "s3cret" not in "".join(capsys.readouterr())


def test_a_password_is_sent_to_its_own_host_alone(tmp_path: Path) -> None:
    """The first server asks for it, and leads to another one."""
    release = tiny_release(tmp_path / "release")
    asked: list[tuple[str, bool]] = []
    with strange_server(lambda path, say: say(file_answer((release / path[1:]).read_bytes()))) as other:
        head = f"HTTP/1.1 302 Found\r\nContent-Length: 0\r\nConnection: close\r\nLocation: {other}"
        with strange_server(lambda path, say: say(f"{head}{path}\r\n\r\n".encode())) as first:
            address = first.replace("http://", "http://user:s3cret@")
            import requests

            real = requests.Session.send

            def send(self: Any, request: Any, **options: Any) -> Any:
                asked.append((request.url, "Authorization" in request.headers))
                return real(self, request, **options)

            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(requests.Session, "send", send)
                assert fetch("tiny", tmp_path / "set", address).fetched == 1
    assert asked[0][1]
    assert [sent for url, sent in asked if url.startswith(other)] == [False, False]


# -- archives and lists ----------------------------------------------------------------------------------------------


def sparse() -> bytes:
    """A member whose extended header says that it is 1 TiB of holes."""
    info, data = member(f"{TITLE}/seal.json", b"0\n")
    info.pax_headers = {"GNU.sparse.major": "1", "GNU.sparse.minor": "0", "GNU.sparse.realsize": str(1 << 40)}
    return packed([(info, data), member(f"{TITLE}/SHA256SUMS", b"")], tarfile.PAX_FORMAT)


def old_sparse() -> bytes:
    data = bytearray(packed([member(f"{TITLE}/seal.json", b"x" * 512)]))
    data[156:157] = tarfile.GNUTYPE_SPARSE
    data[148:156] = b" " * 8
    data[148:156] = b"%06o\0 " % sum(data[:512])
    return bytes(data)


def long_name() -> bytes:
    return packed([member(f"{TITLE}/{'a' * 150}/{'b' * 150}")], tarfile.GNU_FORMAT)


STRANGE = {
    "sparse": (sparse, "which no release has"),
    "old sparse": (old_sparse, "which no release has"),
    "long name": (long_name, "which no release has"),
    "many": (lambda: packed([member(f"{TITLE}/f{k}", b"") for k in range(2000)]), "holds more files than"),
    "no tar": (lambda: b"x" * 10_240, "is no tar file"),
    "cut": (lambda: packed([member(f"{TITLE}/a", b"x" * 20_000)])[:8192], "is no tar file: it ends within a"),
    "a name twice": (lambda: packed([member(f"{TITLE}/a"), member(f"{TITLE}/a")]), "which no release has"),
    "negative size": (
        lambda: packed([member(f"{TITLE}/a")]).replace(b"00000000001\0", b"\xff" * 12, 1),
        "is no tar file|which no release has",
    ),
}


@pytest.mark.parametrize("name", STRANGE)
def test_an_archive_is_looked_at_before_a_file_is_written(name: str, tmp_path: Path) -> None:
    """The manifest names their hashes, so that they are the release's own; trying again would not help."""
    make, words = STRANGE[name]
    data = make()
    files = 3 if name == "many" else 10
    size = len(data) - 512 * files  # what the manifest's own arithmetic allows
    release = tiny_release(tmp_path / "release", archive=data, files=files, size=size)
    message = told(release, tmp_path / "set")
    assert any(word in message for word in words.split("|")), message
    assert "ask who made the release" in message
    assert "run the same command again" not in message
    assert [path for path in (tmp_path / "set.part" / "set").rglob("*") if path.is_file()] == []


def test_empty_files_without_number_are_refused_by_the_manifest_alone(tmp_path: Path) -> None:
    """200 000 empty members need 100 MB of headers, which archives of 23 files do not have."""
    release = tiny_release(tmp_path / "release", files=23, size=1000)
    document = json.loads((release / "MANIFEST.json").read_text())
    document["parts"][TITLE]["archives"][0]["size"] = 200_000 * 512
    (release / "MANIFEST.json").write_text(json.dumps(document))
    assert "do not hold 23 files" in told(release, tmp_path / "set")
    assert not (tmp_path / "set.part").exists()


def test_a_list_of_no_file_verifies_nothing(tmp_path: Path) -> None:
    release = tiny_release(tmp_path / "release", {}, sums=b"")
    assert "lists no file" in told(release, tmp_path / "set")


@pytest.mark.parametrize("broken", ["hash", "missing", "extra"])
def test_a_release_that_contradicts_itself_is_not_to_be_fetched_again(broken: str, tmp_path: Path) -> None:
    line = f"{digest(b'{}')}  seal.json\n"
    sums = {
        "hash": f"{'0' * 64}  frames/a.png\n{line}",
        "missing": f"{'0' * 64}  frames/a.png\n{'0' * 64}  gone.png\n{line}",
        "extra": line,
    }[broken]
    release = tiny_release(tmp_path / "release", sums=sums.encode())
    message = told(release, tmp_path / "set")
    assert "ask who made the release" in message
    assert "run the same command again" not in message


# -- the folder of the fetch -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [".notes", ".hidden/mine.txt", "archives/mine.txt", "archives/.mine", "set/.mine"])
@pytest.mark.parametrize("begun", [False, True])
def test_files_of_others_beside_the_growing_set_stay(name: str, begun: bool, tmp_path: Path) -> None:
    release, stage = tiny_release(tmp_path / "release"), tmp_path / "set.part"
    archive = release / f"{TITLE}-000.tar"
    data = archive.read_bytes()
    if begun:
        archive.unlink()
        told(release, tmp_path / "set")
        archive.write_bytes(data)
    (stage / name).parent.mkdir(parents=True, exist_ok=True)
    (stage / name).write_text("mine")
    assert f"holds other files, such as {name.split('/mine')[0]}" in told(release, tmp_path / "set")
    assert (stage / name).read_text() == "mine"
    (stage / name).unlink()
    if begun:
        if name.startswith(".hidden"):
            (stage / ".hidden").rmdir()
        assert fetch("tiny", tmp_path / "set", str(release)).archives == 1


@pytest.mark.parametrize("names", [("a", "a/b"), ("a/b", "a"), ("a/b/c", "a/b")])
def test_a_file_that_is_a_folder_too_is_no_reason_to_try_again(names: tuple[str, ...], tmp_path: Path) -> None:
    files = dict.fromkeys(names, b"x")
    sums = "".join(f"{digest(data)}  {name}\n" for name, data in sorted(files.items())).encode()
    members = [*(member(f"{TITLE}/{name}", data) for name, data in files.items()), member(f"{TITLE}/SHA256SUMS", sums)]
    release = tiny_release(tmp_path / "release", files, sums=sums, archive=packed(members))
    message = told(release, tmp_path / "set")
    assert f"holds {min(names, key=len)} as a file and as a folder; ask who made the release" in message
    assert "again" not in message


def test_a_fetch_that_was_killed_after_its_end_leaves_nothing(tmp_path: Path) -> None:
    """The set has its name, and its folder of work is there; what is foreign in such a folder stays."""
    release = tiny_release(tmp_path / "release")
    fetch("tiny", tmp_path / "set", str(release))
    rest = tmp_path / "set.part"
    for name in ("fetch.json", "archives/", ".phibench-lock"):
        (rest / name).mkdir(parents=True) if name.endswith("/") else None
        rest.mkdir(exist_ok=True)
        if not name.endswith("/"):
            (rest / name).write_text("{}")
        assert fetch("tiny", tmp_path / "set", str(release)).fetched == 0
        assert not rest.exists()
    rest.mkdir()
    (rest / "mine.txt").touch()
    fetch("tiny", tmp_path / "set", str(release))
    assert (rest / "mine.txt").exists()
