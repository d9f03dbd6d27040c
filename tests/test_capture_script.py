"""docs/capture.py with a camera that is none: what it writes, `phibench sensor fit` reads."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from phibench.calibration.sensor_fit.capture_folder import open_capture
from phibench.calibration.sensor_fit.fit_sensor import fit_sensor

SIZE = (64, 48)
NAMES = (
    *("FOURCC", "FRAME_WIDTH", "FRAME_HEIGHT", "CONVERT_RGB", "AUTO_EXPOSURE", "AUTO_WB", "WB_TEMPERATURE"),
    *("GAIN", "SHARPNESS", "BACKLIGHT", "EXPOSURE"),
)
CV2 = SimpleNamespace(
    **{f"CAP_PROP_{name}": name for name in NAMES}, VideoWriter_fourcc=lambda *letters: "".join(letters)
)


class FakeCamera:
    """A camera that takes controls and sends grey frames, or whatever else is asked of it."""

    def __init__(self, deaf: tuple[str, ...] = (), data: bytes | None = None, broken: bool = False) -> None:
        self.values: dict[str, Any] = {}
        self.deaf, self.data, self.broken, self.rng = deaf, data, broken, np.random.default_rng(1)

    def set(self, name: str, value: Any) -> bool:
        if name not in self.deaf:
            self.values[name] = value
        return name not in self.deaf

    def get(self, name: str) -> Any:
        return self.values.get(name, -1)

    def read(self) -> tuple[bool, Any]:
        if self.broken:
            return False, None
        if self.data is not None:
            return True, np.frombuffer(self.data, np.uint8)
        level = min(20.0 + 1e4 * self.values["EXPOSURE"] * 1e-4 * 0.5, 200.0)
        y = np.rint(self.rng.normal(level, 2.0, SIZE[::-1])).clip(0, 255).astype(np.uint8)
        return True, np.stack([y, np.full_like(y, 128)], axis=-1)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    path = Path(__file__).resolve().parent.parent / "docs/capture.py"
    spec = importlib.util.spec_from_file_location("capture_script", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def step(script: ModuleType, out: Path, camera: FakeCamera, *more: str) -> list[str]:
    told: list[str] = []
    given = ["--out", str(out), "--width", str(SIZE[0]), "--height", str(SIZE[1]), "--frames", "3", *more]
    script.run(script.parsed(given), camera, CV2, sleep=lambda _: None, tell=told.append)
    return told


def test_what_the_script_writes_is_read(script: ModuleType, tmp_path: Path) -> None:
    camera = FakeCamera()
    step(script, tmp_path, camera, "--step", "dark")
    for level in ("00", "01"):
        step(script, tmp_path, camera, "--step", "flat", "--level", level)
    step(script, tmp_path, camera, "--step", "exposure")
    board = ("--columns", "9", "--rows", "7", "--square-m", "0.03")
    step(script, tmp_path, camera, "--step", "chessboard", *board)
    step(script, tmp_path, camera, "--step", "chessboard")
    found = open_capture(tmp_path)
    assert (found.kind, found.size, len(found.flats), len(found.exposures)) == ("yuyv", (48, 64), 2, 7)
    assert found.chessboards is not None
    assert len(found.chessboards.files) == 2
    assert (found.notes.board_columns, found.notes.board_square_m, found.notes.controls["gain"]) == (9, 0.03, 0)
    assert found.stack(found.flats[0]).shape == (3, 48, 64, 2)
    assert [group.seconds for group in found.exposures] == sorted(script.EXPOSURES)
    assert camera.values["AUTO_EXPOSURE"] == 1
    assert fit_sensor(tmp_path).file.preset == "yuyv"


def test_a_control_that_the_camera_does_not_take_is_told(script: ModuleType, tmp_path: Path) -> None:
    told = step(script, tmp_path, FakeCamera(deaf=("AUTO_WB",)), "--step", "dark")
    assert "auto white balance off" in told[0]
    assert len(told) == 2


def test_mjpeg_frames_are_the_cameras_bytes(script: ModuleType, tmp_path: Path) -> None:
    frame = b"\xff\xd8 the frame \xff\xd9"
    step(script, tmp_path, FakeCamera(data=frame + b"\0" * 20), "--step", "dark", "--format", "mjpeg")
    assert (tmp_path / "dark/002.jpg").read_bytes() == frame


@pytest.mark.parametrize(
    ("camera", "more", "reason"),
    [
        (FakeCamera(broken=True), (), "no frame"),
        (FakeCamera(deaf=("FRAME_WIDTH",)), (), "pixels"),
        (FakeCamera(data=b"1234"), (), "OpenCV converts"),
        (FakeCamera(data=b"1234"), ("--format", "mjpeg"), "no JPEG"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(script, tmp_path: Path, camera, more, reason: str) -> None:
    with pytest.raises(script.CaptureError, match=reason):
        step(script, tmp_path, camera, "--step", "dark", *more)


def test_a_folder_keeps_its_controls(script: ModuleType, tmp_path: Path) -> None:
    step(script, tmp_path, FakeCamera(), "--step", "dark")
    with pytest.raises(script.CaptureError, match="another gain"):
        step(script, tmp_path, FakeCamera(), "--step", "dark", "--gain", "64")
