"""Fetching of a released data set from a folder and from a server on the loopback device."""

import gzip
import hashlib
import io
import re
import shutil
import tarfile
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.small_release import Made, flip, snapshot
from helpers.strange_releases import member

from phibench.benchmark.export.export_make import verify_export
from phibench.benchmark.release.fetch import Fetched, fetch, unpack_archive
from phibench.benchmark.release.release_parts import STARTER_PAIRS, Archive
from phibench.benchmark.release.release_source import SOURCE
from phibench.benchmark.scored_dataset import open_dataset
from phibench.benchmark.scores.score_files import read_score
from phibench.benchmark.sealed.sealed_set import read_seal
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_store import verify_films as film_faults
from phibench.datasets.store.checksums import damaged_files, differing_files, read_checksums


def test_fetched_from_a_folder(made: Made, tmp_path: Path, smallest_dataset: Path) -> None:
    done = fetch("small", tmp_path / "set", str(made.out))
    assert done.fetched == done.archives > 3
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    found = snapshot(tmp_path / "set")
    assert found == {name: digest for name, digest in snapshot(smallest_dataset).items() if name in found}
    assert damaged_files(tmp_path / "set") == []
    assert fetch("phibench-v4-small", tmp_path / "set", str(made.out)).fetched == 0
    fetch("films", tmp_path / "films", str(made.out))
    assert film_faults(tmp_path / "films") == []
    fetch("hidden", tmp_path / "hidden", str(made.out))
    assert read_seal(tmp_path / "hidden").pairs == 2


@pytest.mark.slow
def test_the_starter_part_is_fetched_and_scored(
    made: Made, tmp_path: Path, smallest_dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Frames that were fetched are those that are drawn from the layers, with their truth."""
    fetch("starter", tmp_path / "starter", str(made.out))
    assert differing_files(tmp_path / "starter", read_checksums(tmp_path / "starter")) == []
    assert [verify_export(tmp_path / "starter" / preset) for preset in STARTER_PAIRS] == [[], [], []]
    assert main(["dataset", "verify", str(tmp_path / "starter")]) == 0
    folder, mine = tmp_path / "starter" / "mjpeg", tmp_path / "mine.json"
    assert main(["score", str(folder), "--method", "red_centroid", "--out", str(mine)]) == 0
    scored, drawn = read_score(mine), open_dataset(smallest_dataset).pairs("mjpeg")
    assert (scored.pairs, sum(scored.failures.values())) == (len(drawn), 0) == (2, 0)
    for (pair, truth), (other, wanted) in zip(open_dataset(folder), drawn, strict=True):
        assert np.array_equal(pair.down, other.down)
        assert repr(truth) == repr(wanted)
    capsys.readouterr()
    assert main(["score", str(folder), "--method", "red_centroid", "--preset", "yuyv"]) == 2
    assert "none of 'yuyv'" in capsys.readouterr().err
    next(folder.rglob("*.up.*")).unlink()
    assert main(["dataset", "verify", str(tmp_path / "starter")]) == 1
    assert ".up.jpg is missing" in capsys.readouterr().out
    assert main(["score", str(folder), "--method", "red_centroid"]) == 2
    assert "is missing; download the set again" in capsys.readouterr().err
    assert main(["score", str(tmp_path / "starter"), "--method", "red_centroid"]) == 2
    assert "give one of its frames sets" in capsys.readouterr().err


def test_the_place_is_a_setting(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SOURCE, str(made.out))
    assert fetch("films", tmp_path / "set", manifest_sha256=made.released.digest).fetched > 0


@dataclass
class Server:
    """Server of a folder that breaks off: of each name in `broken`, that many answers end half-way.

    `ranges` says whether it gives ranges of bytes; `packed` names what it packs with gzip for the way, unasked.
    `sent` counts bytes of bodies; `asked_from` has the header Range of every request for a name.
    """

    folder: Path
    broken: dict[str, int] = field(default_factory=dict)
    ranges: bool = False
    packed: str = ""
    asked: Counter[str] = field(default_factory=Counter)
    sent: Counter[str] = field(default_factory=Counter)
    asked_from: list[str] = field(default_factory=list)
    address: str = ""

    def answer(self, name: str, range_: str, if_range: str) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body of an answer, as RFC 9110 has them."""
        data = (self.folder / name).read_bytes()
        headers = {"ETag": f'"{hashlib.sha256(data).hexdigest()}"'}
        if name == self.packed:
            return 200, headers | {"Content-Encoding": "gzip"}, gzip.compress(data, mtime=0)
        if not range_ or not self.ranges or if_range not in ("", headers["ETag"]):
            return 200, headers, data
        start = int(range_.removeprefix("bytes=").removesuffix("-"))
        if start >= len(data):
            return 416, headers | {"Content-Range": f"bytes */{len(data)}"}, b""
        return 206, headers | {"Content-Range": f"bytes {start}-{len(data) - 1}/{len(data)}"}, data[start:]


@contextmanager
def served(server: Server) -> Iterator[Server]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            name = self.path.lstrip("/")
            server.asked[name] += 1
            server.asked_from.append(self.headers.get("Range", ""))
            if not (server.folder / name).exists():
                self.send_error(404)
                return
            status, headers, data = server.answer(name, server.asked_from[-1], self.headers.get("If-Range", ""))
            self.send_response(status)
            for key, value in (headers | {"Content-Length": str(len(data))}).items():
                self.send_header(key, value)
            self.end_headers()
            if server.broken.get(name, 0) > 0:
                server.broken[name] -= 1
                data = data[: len(data) // 2]
                self.close_connection = True
            server.sent[name] += len(data)
            self.wfile.write(data)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        server.address = f"http://127.0.0.1:{http.server_address[1]}/"
        try:
            yield server
        finally:
            http.shutdown()
            thread.join()


def test_a_download_that_breaks_off_loses_nothing_and_goes_on(made: Made, tmp_path: Path) -> None:
    archives = [archive.name for archive in made.released.manifest.parts["phibench-v4-small"].archives]
    with served(Server(made.out, {archives[2]: 1})) as server:
        with pytest.raises(DatasetError, match=rf"{archives[2]} from .* broke off: .*run the same command again"):
            fetch("small", tmp_path / "set", server.address, tries=1)
        assert not (tmp_path / "set").exists()
        done = fetch("small", tmp_path / "set", server.address, tries=1)
        assert done.fetched == len(archives) - 2
        assert server.asked[archives[0]] == server.asked[archives[1]] == 1
        assert server.asked[archives[2]] == 2
    assert damaged_files(tmp_path / "set") == []
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_a_file_is_asked_for_again_before_the_fetch_ends(made: Made, tmp_path: Path) -> None:
    name = made.released.manifest.parts["phibench-v4-films"].archives[0].name
    with served(Server(made.out, {name: 1, "MANIFEST.json": 1})) as server:
        assert fetch("films", tmp_path / "set", server.address, tries=2).fetched > 0
        assert (server.asked[name], server.asked["MANIFEST.json"]) == (2, 2)


# Going on within an archive. What the client's buffer holds when a connection ends is lost: 16 KiB at most.

LOST = 1 << 14


def one_archive(made: Made) -> Archive:
    """Largest archive of the films; half of it is more than the client's buffer, so that a loss is seen."""
    archive = max(made.released.manifest.parts["phibench-v4-films"].archives, key=lambda one: one.size)
    assert archive.size // 2 > 2 * LOST
    return archive


def begin(server: Server, out: Path, archive: Archive) -> None:
    """Fetch until the archive has come half-way."""
    server.broken[archive.name] = 1
    with pytest.raises(DatasetError, match=rf"{archive.name} from .* broke off"):
        fetch("films", out, server.address, tries=1)


def test_a_fetch_goes_on_at_the_byte_where_it_ended(made: Made, tmp_path: Path) -> None:
    archive = one_archive(made)
    with served(Server(made.out, ranges=True)) as server:
        begin(server, tmp_path / "set", archive)
        fetch("films", tmp_path / "set", server.address, tries=1)
        start = int(re.findall(r"bytes=(\d+)-", " ".join(server.asked_from))[0])
        assert archive.size // 2 - LOST <= start <= archive.size // 2
        assert server.sent[archive.name] == archive.size // 2 + archive.size - start
    assert film_faults(tmp_path / "set") == []
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_within_a_fetch_the_next_try_goes_on_as_well(made: Made, tmp_path: Path) -> None:
    archive = one_archive(made)
    with served(Server(made.out, {archive.name: 2}, ranges=True)) as server:
        fetch("films", tmp_path / "set", server.address, tries=3)
        assert server.asked[archive.name] == 3
        assert server.sent[archive.name] <= archive.size + 2 * LOST


def test_a_server_without_ranges_sends_all_again(made: Made, tmp_path: Path) -> None:
    archive = one_archive(made)
    with served(Server(made.out)) as server:
        begin(server, tmp_path / "set", archive)
        fetch("films", tmp_path / "set", server.address, tries=1)
        assert server.asked[archive.name] == 2
        assert server.sent[archive.name] == archive.size // 2 + archive.size
    assert film_faults(tmp_path / "set") == []


@pytest.mark.parametrize("tagged", [True, False], ids=["tag", "no_tag"])
def test_a_file_that_was_mended_meanwhile_is_fetched_anew(made: Made, tmp_path: Path, tagged: bool) -> None:
    """The first half is of a damaged file. A tag tells it at once; without one the SHA-256 of the whole does."""
    archive, copy = one_archive(made), tmp_path / "copy"
    shutil.copytree(made.out, copy)
    data = (copy / archive.name).read_bytes()
    (copy / archive.name).write_bytes(b"\0" * 1000 + data[1000:])
    with served(Server(copy, ranges=True)) as server:
        begin(server, tmp_path / "set", archive)
        if not tagged:
            next((tmp_path / "set.part").rglob("*.validator")).write_text("")
        (copy / archive.name).write_bytes(data)
        fetch("films", tmp_path / "set", server.address, tries=1)
        assert server.asked[archive.name] == (2 if tagged else 3)
    assert film_faults(tmp_path / "set") == []


def test_a_file_that_was_damaged_meanwhile_is_refused(made: Made, tmp_path: Path) -> None:
    archive, copy = one_archive(made), tmp_path / "copy"
    shutil.copytree(made.out, copy)
    with served(Server(copy, ranges=True)) as server:
        begin(server, tmp_path / "set", archive)
        flip(copy / archive.name)
        with pytest.raises(DatasetError, match="is damaged: its SHA-256"):
            fetch("films", tmp_path / "set", server.address, tries=1)
        (copy / archive.name).write_bytes((made.out / archive.name).read_bytes() + b"more")
        with pytest.raises(DatasetError, match="is damaged: its SHA-256"):
            fetch("films", tmp_path / "set", server.address, tries=1)
        assert not (tmp_path / "set").exists()
        shutil.copy2(made.out / archive.name, copy)
        fetch("films", tmp_path / "set", server.address, tries=1)
    assert film_faults(tmp_path / "set") == []


def test_bytes_that_were_packed_for_the_way_are_not_gone_on_with(made: Made, tmp_path: Path) -> None:
    archive = one_archive(made)
    with served(Server(made.out, ranges=True, packed=archive.name)) as server:
        begin(server, tmp_path / "set", archive)
        server.packed = ""
        fetch("films", tmp_path / "set", server.address, tries=1)
        assert server.asked_from[-1] == ""
    assert film_faults(tmp_path / "set") == []


def test_bytes_that_are_whole_already_are_not_asked_for(made: Made, tmp_path: Path) -> None:
    """A fetch was killed before they had got their name."""
    archive = one_archive(made)
    with served(Server(made.out, ranges=True)) as server:
        begin(server, tmp_path / "set", archive)
        shutil.copy2(made.out / archive.name, next((tmp_path / "set.part").rglob("*.part")))
        fetch("films", tmp_path / "set", server.address, tries=1)
        assert server.asked[archive.name] == 1


def test_temporary_files_of_a_killed_fetch_are_removed(made: Made, tmp_path: Path) -> None:
    archive, stray = one_archive(made), tmp_path / "set.part" / "archives" / "tmpabcdefgh"
    with served(Server(made.out)) as server:
        begin(server, tmp_path / "set", archive)
        stray.write_bytes(b"0" * 1000)
        begin(server, tmp_path / "set", archive)
        assert not stray.exists()


def test_flipped_bits_and_strange_sources_are_refused(made: Made, tmp_path: Path) -> None:
    def told(source: Path | str, name: str = "small", out: str = "set", **options: Any) -> str:
        with pytest.raises(DatasetError) as caught:
            fetch(name, tmp_path / out, str(source), tries=1, **options)
        assert out != "set" or not (tmp_path / "set").exists()
        return str(caught.value)

    copy = tmp_path / "copy"
    shutil.copytree(made.out, copy)
    victim = made.released.manifest.parts["phibench-v4-small"].archives[1].name
    flip(copy / victim)
    assert f"{victim} from {copy} is damaged" in told(copy)
    with served(Server(copy)) as server:
        assert "is damaged" in told(server.address)
        shutil.copy2(made.out / victim, copy / victim)
        assert fetch("small", tmp_path / "later", server.address, tries=1).fetched > 0
        (copy / victim).unlink()
        assert "does not give" in told(server.address)
    assert "does not answer: check the address" in told("http://127.0.0.1:9/x")
    assert "does not hold 'dev'" in told(copy, "dev")
    assert "no data set 'smal' there; did you mean 'small'?" in told(copy, "smal")
    assert "has another SHA-256 than" in told(copy, manifest_sha256="0" * 64)
    assert "no MANIFEST.json" in told(tmp_path / "later")
    assert "no such folder" in told(tmp_path / "nowhere")
    (copy / "MANIFEST.json").write_text("{}")
    assert "its format is not" in told(copy)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    assert "holds something else than phibench-v4-small" in told(made.out, out="full")
    later = fetch("small", tmp_path / "whole", str(made.out)).folder
    with next(later.rglob("*.exr")).open("ab") as file:
        file.write(b"0")
    assert "damaged or changed" in told(made.out, out="whole")
    assert (tmp_path / "full" / "mine.txt").read_text() == "mine"
    (tmp_path / "new.part").mkdir()
    (tmp_path / "new.part" / "mine.txt").write_text("mine")
    assert "holds other files" in told(made.out, out="new")
    assert (tmp_path / "new.part" / "mine.txt").read_text() == "mine"
    # set.part holds what was fetched of another release
    (tmp_path / "set.part" / "fetch.json").write_text('{"title": "phibench-v4-small", "sums_sha256": "0"}')
    assert "another data set or version" in told(made.out)


def test_what_is_changed_before_it_has_its_name_is_fetched_again(made: Made, tmp_path: Path) -> None:
    """A bit flips in the growing set between two runs."""
    archives = made.released.manifest.parts["phibench-v4-small"].archives
    with served(Server(made.out, {archives[-1].name: 1})) as server:
        with pytest.raises(DatasetError, match="broke off"):
            fetch("small", tmp_path / "set", server.address, tries=1)
        flip(next((tmp_path / "set.part" / "set").rglob("*.exr")))
        with pytest.raises(DatasetError, match=r"is damaged: .*run the same command again"):
            fetch("small", tmp_path / "set", server.address, tries=1)
        assert not (tmp_path / "set").exists()
        assert fetch("small", tmp_path / "set", server.address, tries=1) == Fetched(
            tmp_path / "set", "phibench-v4-small", len(archives), len(archives)
        )


@pytest.mark.parametrize(
    "strange",
    [
        member("title/../outside"),
        member("/title/absolute"),
        member("title/a/../../outside"),
        member("other/file"),
        member("title/.hidden"),
        member("title/link", kind=tarfile.SYMTYPE, target="/etc"),
        member("title/hard", kind=tarfile.LNKTYPE, target="title/good"),
        member("title/fifo", kind=tarfile.FIFOTYPE),
        member("title/folder", kind=tarfile.DIRTYPE),
        member("title/good"),
        member("title/large", b"x" * 200),
    ],
    ids=lambda one: one[0].name.replace("/", "_"),
)
def test_archives_of_others_write_nothing_elsewhere(tmp_path: Path, strange: tuple[tarfile.TarInfo, bytes]) -> None:
    archive, folder = tmp_path / "a.tar", tmp_path / "inside"
    folder.mkdir()
    with tarfile.open(archive, "w") as tar:
        for info, data in (member("title/good", b"good"), strange):
            tar.addfile(info, io.BytesIO(data))
    with pytest.raises(DatasetError, match="nothing of it is used"):
        unpack_archive(archive, folder, "title", 100, 10)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a.tar", "inside"]
