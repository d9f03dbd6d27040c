"""EXR files give back what was written, whatever the memory layout, or raise."""

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store.layers import read_exr, write_exr

LAYOUTS = {
    "C": np.ascontiguousarray,
    "Fortran": np.asfortranarray,
    "strided": lambda a: np.repeat(np.repeat(a, 2, axis=0), 3, axis=1)[::2, ::3],
    "reversed": lambda a: np.ascontiguousarray(a[::-1, ::-1])[::-1, ::-1],
    "transposed": lambda a: np.ascontiguousarray(a.T).T,
    "plane of a stack": lambda a: np.stack([a, a + 1, a], axis=-1)[..., 0],
    "big-endian": lambda a: a.astype(a.dtype.newbyteorder(">")),
    "read-only": lambda a: np.broadcast_to(a, a.shape),
}
FLOATS = st.floats(width=32, allow_nan=True, allow_infinity=True, allow_subnormal=True)
EXAMPLES = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def same(a: Any, b: Any) -> bool:
    """Equal bits, but all NaN are one."""
    a, b = np.asarray(a, np.float32), np.asarray(b, np.float32)
    return bool(np.array_equal(a, b, equal_nan=True) and np.array_equal(np.signbit(a), np.signbit(b)))


@EXAMPLES
@given(
    plane=hnp.arrays(np.float32, hnp.array_shapes(min_dims=2, max_dims=2, max_side=40), elements=FLOATS),
    layout=st.sampled_from(sorted(LAYOUTS)),
    origin=st.tuples(st.integers(-2000, 2000), st.integers(-2000, 2000)),
    number=st.floats(allow_nan=False, allow_infinity=False),
)
def test_round_trip(tmp_path: Path, plane: Any, layout: str, origin: tuple[int, int], number: float) -> None:
    planes = {"R": LAYOUTS[layout](plane), "du.R": plane[::-1], "x_m": plane * 0.5}
    file = read_exr(write_exr(tmp_path / "a.exr", planes, {"number": number}, origin))
    assert set(file.planes) == set(planes)
    assert all(same(file.planes[name], planes[name]) for name in planes)
    assert file.header == {"number": number}  # doubles, not float32
    assert file.origin_px == origin


def test_special_values_survive(tmp_path: Path) -> None:
    plane = np.array([[np.nan, np.inf, -np.inf], [-0.0, 0.0, 1e-45]], np.float32)
    back = read_exr(write_exr(tmp_path / "a.exr", {"A": plane}, {})).planes["A"]
    assert same(back, plane)
    assert np.signbit(back[1, 0])


@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.int16, np.uint8, np.bool_])
def test_other_types_are_rounded_to_float32(tmp_path: Path, dtype: Any) -> None:
    plane = np.arange(12).reshape(3, 4).astype(dtype)
    back = read_exr(write_exr(tmp_path / "a.exr", {"A": plane}, {})).planes["A"]
    assert back.dtype == np.float32
    assert same(back, plane)


def test_equal_content_gives_equal_bytes(tmp_path: Path) -> None:
    plane = np.random.default_rng(1).random((50, 60))
    a, b = (write_exr(tmp_path / name, {"A": plane, "B": -plane}, {"k": 0.1}) for name in ("a.exr", "b.exr"))
    assert a.read_bytes() == b.read_bytes()


@pytest.mark.parametrize(
    ("planes", "words"),
    [
        ({}, "one shape"),
        ({"A": np.zeros((2, 3)), "B": np.zeros((3, 2))}, "one shape"),
        ({"A": np.zeros(3)}, "shape"),
        ({"A": np.zeros((0, 3))}, "above 0"),
        ({"A": np.zeros((2, 2), complex)}, "real"),
        ({"A": np.full((2, 2), 1e39)}, "beyond float32"),
    ],
)
def test_what_cannot_be_stored_is_refused(tmp_path: Path, planes: Any, words: str) -> None:
    with pytest.raises(DatasetError, match=words):
        write_exr(tmp_path / "a.exr", planes, {})
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def file(tmp_path: Path) -> Path:
    plane = np.random.default_rng(2).random((64, 80))
    return write_exr(tmp_path / "a.exr", {"A": plane, "B": plane + 1.0}, {"k": 1})


@pytest.mark.parametrize("kept", [0, 5, 100, 400, 0.5, 0.9, -1])
def test_a_truncated_file_raises(file: Path, kept: float) -> None:
    data = file.read_bytes()
    end = int(len(data) * kept) if isinstance(kept, float) else kept
    file.write_bytes(data[:end])
    with pytest.raises(DatasetError, match="damaged"):
        read_exr(file)


def test_a_flipped_bit_in_the_pixels_raises(file: Path) -> None:
    data = file.read_bytes()
    start = data.index(b"screenWindowWidth") + 100
    checked = 0
    for place in range(start, len(data), max(1, (len(data) - start) // 40)):
        changed = bytearray(data)
        changed[place] ^= 0x10
        file.write_bytes(changed)
        with pytest.raises(DatasetError):
            read_exr(file)
        checked += 1
    assert checked >= 40


def test_missing_and_foreign_files_raise(tmp_path: Path) -> None:
    import OpenEXR

    with pytest.raises(DatasetError, match="missing"):
        read_exr(tmp_path / "none.exr")
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"A": np.zeros((2, 2), np.float32)}) as foreign:
        foreign.write(str(tmp_path / "foreign.exr"))
    with pytest.raises(DatasetError, match="not written by phibench"):
        read_exr(tmp_path / "foreign.exr")


@pytest.mark.parametrize("kept", [100, 0.5, 0.9])
def test_a_damaged_file_is_told_by_the_exception_only(
    file: Path, kept: float, capfd: pytest.CaptureFixture[str]
) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * kept) if isinstance(kept, float) else kept])
    with pytest.raises(DatasetError, match="damaged"):
        read_exr(file)
    os.write(2, b"heard again")
    assert capfd.readouterr() == ("", "heard again")


def test_a_file_that_may_not_be_read_is_not_called_missing(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "open", denied)
    with pytest.raises(DatasetError, match="not readable: Permission denied"):
        read_exr(file)
