"""Command `phibench sensor fit`: file, page, printed table; the same bytes again; faults with exit code 2."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.sensor_captures import write_processed_capture, write_raw_capture

from phibench.cli.main import main
from phibench.datasets.frames.sensor_file import read_sensor_file
from phibench.render.sensor.settings import sensor


def test_the_command_writes_file_and_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_raw_capture(tmp_path / "c", sensor("mono-raw"), 0, (0.2, 0.6), frames=4, dark_frames=8)
    for name in ("a", "b"):
        page, out = tmp_path / f"{name}.html", tmp_path / f"{name}.toml"
        assert main(["sensor", "fit", str(folder), "--out", str(out), "--page", str(page)]) == 0
    printed = capsys.readouterr().out
    assert "gain_dn_per_e" in printed
    assert "dark_e_per_s: not determined from these frames" in printed
    for suffix in (".html", ".toml"):
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    text = (tmp_path / "a.html").read_text()
    assert "data:image/png" in text
    assert "read_noise_e" in text
    assert read_sensor_file(tmp_path / "a.toml").sensor().mosaic == "mono"


@pytest.mark.slow
def test_a_markdown_page_has_its_picture_beside_it(tmp_path: Path) -> None:
    folder = write_processed_capture(tmp_path / "c", sensor("yuyv"), 0, frames=2, side=64)
    page, out = tmp_path / "page.md", tmp_path / "s.toml"
    assert main(["sensor", "fit", str(folder), "--out", str(out), "--page", str(page)]) == 0
    assert "![Plots of the fit](page.png)" in page.read_text()
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")


def test_faults_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_raw_capture(tmp_path / "c", sensor("mono-raw"), 0, (0.2,), frames=2, dark_frames=2)
    out = str(tmp_path / "s.toml")
    assert main(["sensor", "fit", str(tmp_path / "none"), "--out", out]) == 2
    assert main(["sensor", "fit", str(folder), "--out", out, "--page", str(tmp_path / "p.pdf")]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2
    assert "is no folder" in said[0]
    assert ".html or .md" in said[1]
