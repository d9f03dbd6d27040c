"""Text of settings: encodings and line ends of other editors are read, and habits of other languages are named."""

from __future__ import annotations

from pathlib import Path

import pytest

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile

_TEXT = '[rig]\nradius_m = 0.05\n\n[rig.holder]\nkind = "rods"\n'


def tables(path: Path, data: bytes) -> dict[str, object]:
    path.write_bytes(data)
    return InputFile(path, "mend it").toml()


@pytest.mark.parametrize(
    "data",
    [
        _TEXT.encode("utf-16"),
        b"\xfe\xff" + _TEXT.encode("utf-16-be"),
        _TEXT.encode("utf-16-le"),
        _TEXT.encode("utf-8-sig"),
        _TEXT.replace("\n", "\r\n").encode(),
        _TEXT.replace("\n", "\r").encode(),
        _TEXT.replace("radius_m =", "\tradius_m\t=").encode(),
    ],
    ids=["utf-16", "utf-16-be", "utf-16-le", "mark", "crlf", "cr", "tabs"],
)
def test_files_of_other_editors_are_read(tmp_path: Path, data: bytes) -> None:
    assert tables(tmp_path / "a.toml", data) == {"rig": {"radius_m": 0.05, "holder": {"kind": "rods"}}}


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("k1 = True", "true and false in small letters"),
        ("k1 = None", "leave the key out"),
        ("radius_m = 0,06", "decimal point, no comma"),
        ("radius_m = 60 mm", "a number has no unit"),
        ("radius_m = .06", "a digit stands before the decimal point"),
        ("fx_px = 1430.", "a digit stands after the decimal point"),
        ("fx_px = 1'430.0", "no mark between thousands"),
        ("k1 = \u22120.026", "minus is the sign -"),
        ("preset = \u201cdefault\u201d", "quotes are straight ones"),
        ("preset = default", "a text stands in quotes"),
        ("radius_m: 0.06", "between key and value stands ="),
        ("radius_m = 0.06;", "a remark begins with #"),
        ("radius_m = 0.12/2", "a number is written out"),
        ("radius_m = 0.06 +- 0.001", "without its uncertainty"),
        ("radius_m = 0.06, z_c_m = 0.26", "each key has a line of its own"),
        ("laser_filter_response = (1.0, 0.1, 0.03)", "square brackets"),
        ("radius_m = 0.06\nradius_m = 0.05", "stands twice"),
        ("radius_m\u00a0= 0.06", "a sign that is not seen"),
    ],
)
def test_habits_of_other_languages_are_named(tmp_path: Path, line: str, words: str) -> None:
    with pytest.raises(DatasetError) as caught:
        tables(tmp_path / "a.toml", f"[rig]\n{line}\n".encode())
    assert words in str(caught.value)
    assert "not valid TOML" in str(caught.value)
