"""Calibrations of other programs as a rig file: the numbers to copy, by the programs' own writers, or why not."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from phibench.calibration.captures.rig_file import read_rig_file
from phibench.datasets.common.errors import DatasetError

K = np.array([[1432.5, 0.0, 640.25], [0.0, 1431.75, 355.5], [0.0, 0.0, 1.0]])
D = np.array([-0.026, 1.06, 0.001, -0.002, -3.4])
NUMBERS = ("fx_px = 1432.5", "fy_px = 1431.75", "cx_px = 640.25", "cy_px = 355.5")
LENS = ("k1 = -0.026", "k2 = 1.06", "p1 = 0.001", "p2 = -0.002")
SIZE = ("width_px = 1280", "height_px = 720")
ROS = {
    "image_width": 1280,
    "image_height": 720,
    "camera_name": "c310",
    "camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()},
    "distortion_model": "plumb_bob",
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": D.tolist()},
    "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
}
MESSAGE = {"height": 720, "width": 1280, "distortion_model": "plumb_bob", "d": D.tolist(), "k": K.ravel().tolist()}
KALIBR = {
    "cam0": {
        "camera_model": "pinhole",
        "intrinsics": [1432.5, 1431.75, 640.25, 355.5],
        "distortion_model": "radtan",
        "distortion_coeffs": D[:4].tolist(),
        "resolution": [1280, 720],
        "rostopic": "/cam0/image_raw",
    }
}


def said(folder: Path, text: str) -> str:
    """The one sentence about a rig file with this text."""
    path = folder / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DatasetError) as error:
        read_rig_file(path)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_opencv_writes_what_is_copied(tmp_path: Path, suffix: str) -> None:
    file = str(tmp_path / f"camera.{suffix}")
    storage = cv2.FileStorage(file, cv2.FILE_STORAGE_WRITE)
    for key, value in {"image_width": 1280, "image_height": 720, "camera_matrix": K}.items():
        storage.write(key, value)
    storage.write("distortion_coefficients", D[None])
    storage.release()
    text = said(tmp_path, Path(file).read_text())
    for words in ("of OpenCV", *SIZE, *NUMBERS, *LENS, "k3 = -3.4", "radius_m and z_c_m"):
        assert words in text


@pytest.mark.parametrize("flow", [True, False])
def test_ros_and_kalibr(tmp_path: Path, flow: bool) -> None:
    """Lists in brackets, and one number a line."""

    def dumped(document: object) -> str:
        return yaml.safe_dump(document, default_flow_style=None if flow else False, sort_keys=False)

    for document, program in ((ROS, "ROS"), (MESSAGE, "ROS"), (KALIBR, "Kalibr")):
        text = said(tmp_path, dumped(document))
        for words in (program, *SIZE, *NUMBERS, *LENS):
            assert words in text, (program, words)
        assert ("k3 = -3.4" in text) == (program == "ROS")
    capital = {"K" if key == "k" else "D" if key == "d" else key: value for key, value in MESSAGE.items()}
    assert NUMBERS[0] in said(tmp_path, dumped(capital))
    bent = {**KALIBR["cam0"], "distortion_model": "equidistant"}
    text = said(tmp_path, dumped({"cam0": bent, "cam1": bent}))
    assert "equidistant" in text
    assert "k1 = " not in text
    assert "first camera of 2" in text
    rational = {**ROS, "distortion_coefficients": {"rows": 1, "cols": 8, "data": [*D.tolist(), 0.5, 0.0, 0.0]}}
    assert "its k4 have no keys" in said(tmp_path, dumped(rational))


def test_a_dumped_matrix_is_known(tmp_path: Path) -> None:
    text = said(tmp_path, json.dumps({"camera_matrix": K.tolist(), "dist_coeffs": [D.tolist()]}))
    for words in (*NUMBERS, *LENS):
        assert words in text


_ONE_ROW = "1432.5 1431.75 640.25 355.5"
LINES = {
    "EuRoC": "sensor_type: camera\nT_BS:\n  cols: 4\n  data: [0.1, 0.9, 0.2, 3.0]\nrate_hz: 20\n"
    "resolution: [1280, 720]\nintrinsics: [1432.5, 1431.75, 640.25, 355.5] #fu, fv, cu, cv\n"
    "distortion_model: radial-tangential\ndistortion_coefficients: [-0.026, 1.06, 0.001, -0.002]\n",
    "Kalibr": "Calibration results\n=====\ncam0 (/cam0):\n    distortion: [-0.026 1.06 0.001 -0.002] "
    "+- [0.1 0.1 0.1 0.1]\n"
    f"    projection: [{_ONE_ROW}] +- [0.5 0.5 0.6 0.4]\n",
    "ORB-SLAM": '%YAML:1.0\nCamera.type: "PinHole"\nCamera.fx: 1432.5\nCamera.fy: 1431.75\nCamera.cx: 640.25\n'
    "Camera.cy: 355.5\nCamera.k1: -0.026\nCamera.k2: 1.06\nCamera.p1: 0.001\nCamera.p2: -0.002\n",
    "COLMAP": "# cameras\n1 OPENCV 1280 720 1432.5 1431.75 640.75 356.0 -0.026 1.06 0.001 -0.002\n",
    # jsonencode of MATLAB's cameraParameters: the first pixel is 1, the size is rows and columns, K beside it
    "MATLAB": '{"RadialDistortion": [-0.026, 1.06], "TangentialDistortion": [0.001, -0.002], "ImageSize": [720, 1280], '
    '"FocalLength": [1432.5, 1431.75], "PrincipalPoint": [641.25, 356.5], "Skew": 0, '
    '"K": [[1432.5, 0, 641.25], [0, 1431.75, 356.5], [0, 0, 1]]}',
    "Bouguet": "fc = [ 1432.5 ; 1431.75 ];\ncc = [ 640.25 ; 355.5 ];\nalpha_c = 0.0;\n"
    "kc = [ -0.026 ; 1.06 ; 0.001 ; -0.002 ; 0.0 ];\nnx = 1280;\nny = 720;\n",
    "ROS": "[image]\n\nwidth\n1280\n\nheight\n720\n\n[c310]\n\ncamera matrix\n1432.5 0.0 640.25\n0.0 1431.75 355.5\n"
    "0.0 0.0 1.0\n\ndistortion\n-0.026 1.06 0.001 -0.002 0.0\n\nrectification\n1.0 0.0 0.0\n",
    # Metashape: u = w / 2 + cx + (f + b1) x, the first pixel at 0.5, p1 and p2 in the other order
    "Metashape": "<calibration>\n  <projection>frame</projection>\n  <width>1280</width>\n  <height>720</height>\n"
    "  <f>1431.75</f>\n  <cx>0.75</cx>\n  <cy>-4</cy>\n  <b1>0.75</b1>\n  <k1>-0.026</k1>\n  <k2>1.06</k2>\n"
    "  <p1>-0.002</p1>\n  <p2>0.001</p2>\n</calibration>\n",
    "Nerfstudio": '{"camera_model": "OPENCV", "fl_x": 1432.5, "fl_y": 1431.75, "cx": 640.75, "cy": 356.0, "w": 1280, '
    '"h": 720, "k1": -0.026, "k2": 1.06, "p1": 0.001, "p2": -0.002, "frames": []}',
    "RealSense": '{"width": 1280, "height": 720, "ppx": 640.25, "ppy": 355.5, "fx": 1432.5, "fy": 1431.75, '
    '"model": "brown_conrady", "coeffs": [-0.026, 1.06, 0.001, -0.002, 0.0]}',
    "another program": "fx: 1432.5\nfy: 1431.75\ncx: 640.25\ncy: 355.5\nk1: -0.026\nk2: 1.06\np1: 0.001\np2: -0.002\n",
    "CamOdoCal": "model_type: PINHOLE\nprojection_parameters:\n   fx: 1432.5\n   fy: 1431.75\n   cx: 640.25\n"
    "   cy: 355.5\ndistortion_parameters:\n   k1: -0.026\n   k2: 1.06\n   p1: 0.001\n   p2: -0.002\n",
}


@pytest.mark.parametrize("program", LINES)
def test_other_programs_write_what_is_copied(tmp_path: Path, program: str) -> None:
    """Numbers of one camera as each program's own documentation writes them; COLMAP's first pixel is at 0.5."""
    text = said(tmp_path, LINES[program])
    for words in (f"of {program}", *NUMBERS, *LENS):
        assert words in text
    assert "width_px" not in text or all(words in text for words in SIZE)


def test_all_models_of_colmap_are_known(tmp_path: Path) -> None:
    full = said(tmp_path, f"1 FULL_OPENCV 1280 720 {_ONE_ROW} -0.026 1.06 0.001 -0.002 -3.4 0.5 0 0\n")
    for words in ("of COLMAP", *SIZE, *LENS, "k3 = -3.4", "its k4 have no keys"):
        assert words in full
    for model in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "FOV"):
        text = said(tmp_path, f"1 {model} 1280 720 {_ONE_ROW} 0 0 0 0 0 0 0 0\n")
        assert f"its distortion '{model}' has no keys" in text


def test_binned_pictures_have_other_numbers(tmp_path: Path) -> None:
    """ROS keeps the numbers of the whole sensor in camera_info; 0 and 1 mean none."""
    binned = {**MESSAGE, "binning_x": 2, "binning_y": 2}
    assert "binned 2 x 2, and these numbers are of the whole sensor" in said(tmp_path, yaml.safe_dump(binned))
    for none in (0, 1):
        assert "are binned" not in said(tmp_path, yaml.safe_dump({**binned, "binning_x": none, "binning_y": none}))


def test_what_a_matrix_may_hide(tmp_path: Path) -> None:
    """Columns before rows (Open3D), a skew, the size as one list, a second camera."""
    by_columns = json.dumps({"width": 1280, "height": 720, "intrinsic_matrix": K.T.ravel().tolist()})
    assert all(words in said(tmp_path, by_columns) for words in (*SIZE, *NUMBERS))
    skewed = K.copy()
    skewed[0, 1] = 2.5
    assert "its skew of 2.5" in said(tmp_path, json.dumps({"camera_matrix": skewed.tolist()}))
    two = said(tmp_path, json.dumps({"imageSize": [1280, 720], "M1": K.tolist(), "M2": (2 * K).tolist()}))
    assert all(words in two for words in (*SIZE, *NUMBERS, "first camera of 2"))


def test_a_key_outside_its_table_is_told(tmp_path: Path) -> None:
    assert "begin the file with a line [rig]" in said(tmp_path, "fx_px = 1430.0\n")


OMNI = {**KALIBR["cam0"], "camera_model": "omni", "intrinsics": [1.7, 1432.5, 1431.75, 640.25, 355.5]}
IN_ONE = {
    "OCamCalib": "#polynomial coefficients for the DIRECT mapping function (ocam_model.ss).\n\n5 -2.6e+02 0.0",
    "Kalibr": yaml.safe_dump({"cam0": OMNI}),
    "OpenCV": "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [ 500., 0., 320., 0., 500., 240., 0., 0., 1. ]\nxi: 1.2\n",
    "CamOdoCal": "%YAML:1.0\n---\nmodel_type: MEI\nimage_width: 752\nmirror_parameters:\n   xi: 1.1\n",
    "Basalt": '{"value0": {"intrinsics": [{"camera_type": "ds", "intrinsics": {"fx": 350.0, "xi": -0.2}}]}}',
}


@pytest.mark.parametrize("program", IN_ONE)
def test_a_model_of_mirror_and_camera_cannot_be_split(tmp_path: Path, program: str) -> None:
    text = said(tmp_path, IN_ONE[program])
    assert program in text
    assert "mirror and camera in one" in text
    assert "cannot be split" in text
    assert "fx_px =" not in text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"rig": {"fx_px": 1430.0}}', "but JSON: write a line [rig]"),
        ("rig:\n  fx_px: 1430\n", "but YAML"),
        ("<robot/>", "but XML"),
        ('{"kind": "phibench calibration", "version": 2}', "--calibration"),
        ("\x89PNG\r\n", "is a picture: give it with --down"),
        ('preset = "bayer-raw"\nadc_bits = 10\n', "is a sensor file: give it with --sensor"),
        ('format = "bayer-raw"\nwidth_px = 160\nbits = 12\n', "describes frames, not a rig"),
        ('preset = "mono-raw"\n', "a preset that is no rig's"),
        ("[recipe]\n[rig]\n", "is a recipe: copy its tables"),
        ("[mirror]\nradius_m = 0.03\n", "write [rig.mirror]"),
        ("[camera]\nfx_px = 1430.0\n", "camera: unknown key; camera and mirror are described in the table [rig]"),
        ("[rig]\nresolution = [1280, 720]\n", "write width_px and height_px"),
        ("[rig]\nmirror_diameter_mm = 60\n", "half its diameter, is radius_m"),
        ("[rig.mirror]\ndiameter_m = 0.06\n", "and needs no [rig.mirror]"),
        ("[rig]\nfx_mm = 4.0\n", "millimetres over the pixel pitch as fx_px"),
        ("[rig]\nstroke_m = 0.4\n", "--stroke-m"),
        ("[rig.laser]\ndiameter_m = 0.003\n", "a line [laser]"),
        ("[rig]\ndistortion = [0.1, 0.0]\n", "write k1, k2, p1, p2 and k3"),
        ("[rig]\nz_c_mm = 262.0\n", "write z_c_m, in metres"),
        ("[rig]\nstroke_tilt_x_deg = 0.5\n", "write stroke_tilt_x_rad, in radians"),
        ("[rig]\npixel_pitch_mm = 0.0028\n", "write pixel_pitch_um, in micrometres"),
        ("[rig]\nz_c_m = 0,262\n", "numbers have a decimal point, no comma"),
        ("[rig]\ndiagonal_fov_deg = 60.0\n", "fov_deg is the horizontal field of view"),
        ("[rig]\ndepth_m = 2.1\n", "that of a tape stands in pairs.csv"),
    ],
)
def test_another_file_or_key_is_told_what_it_is(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DatasetError) as error:
        read_rig_file(path)
    assert words in str(error.value)
    assert "did you mean" not in str(error.value)


def test_what_is_none_of_them_is_no_toml(tmp_path: Path) -> None:
    for text in ("nonsense", "rig:\n  fx_px: 1430\n", "[rig\nfx_px = 3"):
        assert "is not valid TOML" in said(tmp_path, text)
    (tmp_path / "calib.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(range(256)))
    with pytest.raises(DatasetError, match=r"Bouguet.*fc as fx_px.*OCamCalib.*cannot be split"):
        read_rig_file(tmp_path / "calib.mat")
    np.savez(tmp_path / "calib.npz", mtx=K)
    with pytest.raises(DatasetError, match="NumPy"):
        read_rig_file(tmp_path / "calib.npz")
