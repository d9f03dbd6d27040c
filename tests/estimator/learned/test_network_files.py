"""Networks of strangers: each attack on a file of weights ends in a sentence, before anything of the file runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from phibench.estimator.learned import networks
from phibench.estimator.learned.network_file import _fields, read_model
from phibench.estimator.learned.network_graphs import CROP, DETECT
from phibench.estimator.learned.networks import Network, NetworkError, covariances, sealed_model, shipped_network
from phibench.scenes.random_streams import generator

FOLDER = Path(networks.__file__).parent
BARE = {name: (FOLDER / f"{name}.onnx").read_bytes()[:-76] for name in (CROP, DETECT)}  # without the entry of the hash
GRAPH, METADATA, INITIALIZER, NODE, OUTPUT = 7, 14, 5, 1, 12
Fields = list[tuple[int, int | bytes]]


def parts(data: bytes) -> Fields:
    return [(number, x if isinstance(x, int) else bytes(x)) for number, x in _fields(memoryview(data))]


def varint(value: int) -> bytes:
    out = b""
    while value > 0x7F:
        out, value = out + bytes([value & 0x7F | 0x80]), value >> 7
    return out + bytes([value])


def message(fields: Fields) -> bytes:
    return b"".join(
        varint(number << 3) + varint(x) if isinstance(x, int) else varint(number << 3 | 2) + varint(len(x)) + x
        for number, x in fields
    )


def in_graph(change: Callable[[Fields], Fields]) -> Callable[[bytes], bytes]:
    return lambda data: message([(n, message(change(parts(x))) if n == GRAPH else x) for n, x in parts(data)])  # type: ignore[arg-type]


def first(number: int, change: Callable[[Fields], Fields]) -> Callable[[Fields], Fields]:
    """The first field of a number, changed."""

    def changed(fields: Fields) -> Fields:
        place = next(k for k, (n, _) in enumerate(fields) if n == number)
        return [*fields[:place], (number, message(change(parts(fields[place][1])))), *fields[place + 1 :]]  # type: ignore[arg-type]

    return changed


def entry(key: str, value: str | None) -> Callable[[bytes], bytes]:
    """The metadata with another value, or without the key."""

    def changed(data: bytes) -> bytes:
        kept = [(n, x) for n, x in parts(data) if n != METADATA or dict(parts(x))[1] != key.encode()]  # type: ignore[arg-type]
        more = [] if value is None else [(METADATA, message([(1, key.encode()), (2, value.encode())]))]
        return message([*kept, *more])

    return changed


def elsewhere(fields: Fields) -> Fields:
    """Weights of the file "w.bin" in the working directory."""
    place = message([(1, b"location"), (2, b"w.bin")])
    return [*((n, x) for n, x in fields if n != 9), (13, place), (14, 1)]


def with_raw(change: Callable[[bytes], bytes]) -> Callable[[Fields], Fields]:
    return lambda fields: [(n, change(x) if n == 9 else x) for n, x in fields]  # type: ignore[arg-type]


def node(kind: bytes, *more: tuple[int, bytes]) -> tuple[int, bytes]:
    return NODE, message([(1, b"size"), (2, b"huge"), (4, kind), *more])


EIGHT_GB = message([(1, 1), (2, 7), (8, b"size"), (9, np.array([2**31], "<i8").tobytes())])
HIDDEN_TENSOR = message([(1, b"value"), (5, message(elsewhere([(1, 4), (2, 1), (8, b"x")]))), (20, 4)])
WITH_WORDS: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "weights in another file": (in_graph(first(INITIALIZER, elsewhere)), "keeps weights in another file"),
    "the same in a constant": (in_graph(lambda g: [node(b"Constant", (5, HIDDEN_TENSOR)), *g]), "no whole number"),
    "a constant of 8 GB": (
        in_graph(lambda g: [node(b"ConstantOfShape"), (INITIALIZER, EIGHT_GB), *g]),
        "other layers than this network: it has ConstantOfShape",
    ),
    "a shape of 8 GB": (in_graph(first(INITIALIZER, lambda t: [(1, 2**31), *t])), "of another size than their shape"),
    "no output": (in_graph(lambda g: [(n, x) for n, x in g if n != OUTPUT]), "has the outputs -: "),
    "weights that are no numbers": (
        in_graph(first(INITIALIZER, with_raw(lambda raw: b"\0\0\xc0\x7f" + raw[4:]))),
        "that are not finite",
    ),
    "weights twice": (
        in_graph(lambda g: [*g, next(one for one in g if one[0] == INITIALIZER)]),
        "twice",
    ),
    "weights that nobody asks for": (in_graph(lambda g: [*g, (INITIALIZER, EIGHT_GB)]), "does not know"),
    "weights left out": (in_graph(lambda g: [one for one in g if one[0] != INITIALIZER]), "has no weights"),
    "a layer left out": (in_graph(lambda g: g[1:]), "other layers"),
    "a layer of others": (in_graph(first(NODE, lambda x: [*x, (7, b"com.other")])), "not ONNX's own"),
    "sparse weights": (in_graph(lambda g: [*g, (15, b"")]), "field 15 of the graph"),
    "functions": (lambda data: data + message([(25, b"")]), "field 25 of the model"),
    "other operators": (lambda data: data + message([(8, message([(2, 99)]))]), "ONNX's of version 17"),
    "no scale": (entry("covariance_scale", None), "states no number covariance_scale"),
    "a scale in words": (entry("covariance_scale", "one"), "states no number covariance_scale"),
    "a scale of nan": (entry("covariance_scale", "nan"), "covariance_scale = nan: a finite number above 0"),
    "a negative scale": (entry("covariance_scale", "-1"), "covariance_scale = -1: a finite"),
    "an infinite scale": (entry("covariance_scale", "inf"), "covariance_scale = inf: a finite"),
    "a name that clears the terminal": (entry("name", "\x1b[2J"), "not 'learned_"),
    "more than a mebibyte": (entry("settings", "x" * (1 << 20)), "larger than 1 MiB"),
    "half a file": (lambda data: data[: len(data) // 2], "no ONNX model"),
    "no field that ends": (lambda data: b"\xff" * 100, "no ONNX model"),
}


@pytest.fixture
def nothing_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    def build(model: bytes, file: Any) -> Any:
        raise AssertionError("the file's network was built")

    monkeypatch.setattr(networks, "_session", build)


@pytest.mark.usefixtures("nothing_runs")
@pytest.mark.parametrize("name", [CROP, DETECT])
@pytest.mark.parametrize("attack", WITH_WORDS)
def test_an_attack_is_refused_in_a_sentence_before_anything_runs(name: str, attack: str, tmp_path: Path) -> None:
    change, words = WITH_WORDS[attack]
    path = tmp_path / "mine.onnx"
    path.write_bytes(sealed_model(change(BARE[name])))
    with pytest.raises(NetworkError) as caught:
        Network(path, name)
    said = str(caught.value)
    assert words in said
    assert said.isprintable()
    assert len(said) < 400


@pytest.mark.usefixtures("nothing_runs")
def test_one_output_of_two_is_refused(tmp_path: Path) -> None:
    def without_last(graph: Fields) -> Fields:
        last = max(k for k, (n, _) in enumerate(graph) if n == OUTPUT)
        return [*graph[:last], *graph[last + 1 :]]

    (tmp_path / "mine.onnx").write_bytes(sealed_model(in_graph(without_last)(BARE[CROP])))
    with pytest.raises(NetworkError, match="has the outputs uv_px: uv_px, factor are needed"):
        Network(tmp_path / "mine.onnx", CROP)


@pytest.mark.usefixtures("nothing_runs")
def test_the_pinned_hash_is_compared_before_anything_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks, "SHIPPED", {CROP: "0" * 64})
    with pytest.raises(NetworkError, match="belongs to another release"):
        shipped_network(CROP)


def test_shipped_files_are_written_as_they_are_read() -> None:
    """The reader of the tests puts a file together again to the byte, so that each attack is the one thing changed."""
    for data in BARE.values():
        assert message(parts(data)) == in_graph(lambda graph: graph)(data) == data
        assert len(read_model(data).tensors) > 5


def refusal(path: Path, name: str) -> str:
    """What is said against a file; "" if it is taken."""
    try:
        Network(path, name)
    except NetworkError as error:
        return str(error)
    return ""


def test_random_damage_ends_in_a_sentence_or_in_other_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Signed anew, so that nothing but the contents can tell. Most bytes are weights: those are not refused."""
    monkeypatch.setattr(networks, "_session", lambda model, file: None)
    rng, refused, path = generator("tests", "damaged networks"), 0, tmp_path / "mine.onnx"
    heads = {name: data.rindex(b"covariance_scale") for name, data in BARE.items()}
    for k in range(300):
        name = (CROP, DETECT)[k % 2]
        data = bytearray(BARE[name])
        near = (0, heads[name] - 300, 0)[k % 3], (1500, len(data), len(data))[k % 3]
        data[int(rng.integers(*near))] ^= int(rng.integers(1, 256))
        path.write_bytes(sealed_model(bytes(data)))
        said = refusal(path, name)
        assert said.isprintable()
        refused += bool(said)
    assert 100 < refused < 300


def test_thresholds_and_factors_of_any_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks, "_session", lambda model, file: None)
    for text, words in (("{}", "no two thresholds"), ("[1", "no two"), ('{"srgb8": [1, NaN]}', "not finite")):
        path = tmp_path / "mine.onnx"
        path.write_bytes(sealed_model(entry("thresholds", text)(BARE[DETECT])))
        with pytest.raises(NetworkError, match=words):
            Network(path, DETECT).thresholds("srgb8")
    extreme = covariances(np.array([[1e3, 0.0, -1e3], [-1e30, 1.0, 1e30]]), 1.0)
    assert np.isfinite(extreme).all()
