"""Frames of a camera, in the folder that `phibench sensor fit` reads. Needs OpenCV only; copy it wherever it is needed.

    python capture.py --out capture --step dark
    python capture.py --out capture --step flat --level 03
    python capture.py --out capture --step exposure
    python capture.py --out capture --step chessboard --columns 9 --rows 7 --square-m 0.03

Each run takes the frames of one step. Frames are stored as the camera sent them: YUYV without a header, or the bytes of
each MJPEG frame. Exposure, gain and white balance are fixed first and read back.
"""

import argparse
import sys
import time
from pathlib import Path

FOURCC = {"yuyv": "YUYV", "mjpeg": "MJPG"}
SUFFIX = {"yuyv": ".yuyv", "mjpeg": ".jpg"}
SETTLE_FRAMES = 30  # after a change of controls; the camera applies them some frames late
EXPOSURES = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.033)  # seconds
CONTROLS = (  # name in OpenCV, value, name for people; 100 us is the unit of exposure
    ("CAP_PROP_AUTO_EXPOSURE", 1, "auto exposure off"),
    ("CAP_PROP_AUTO_WB", 0, "auto white balance off"),
    ("CAP_PROP_WB_TEMPERATURE", 4000, "white balance 4000 K"),
    ("CAP_PROP_GAIN", 0, "gain"),
    ("CAP_PROP_SHARPNESS", 24, "sharpness"),
    ("CAP_PROP_BACKLIGHT", 0, "backlight compensation off"),
)


class CaptureError(Exception):
    """What a person has to mend; one sentence."""


def set_up(camera, cv2, form, width, height, gain, sharpness):
    """Format, size and controls; returns what could not be set."""
    camera.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter_fourcc(*FOURCC[form]))
    camera.set(cv2.CAP_PROP_FRAME_WIDTH, width)
    camera.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
    camera.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # the bytes, not a picture of them
    given = {"CAP_PROP_GAIN": gain, "CAP_PROP_SHARPNESS": sharpness}
    kept = []
    for name, value, meaning in CONTROLS:
        value = given.get(name, value)
        camera.set(getattr(cv2, name), value)
        if camera.get(getattr(cv2, name)) != value:
            kept.append(meaning)
    size = (int(camera.get(cv2.CAP_PROP_FRAME_WIDTH)), int(camera.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    if size != (width, height):
        raise CaptureError(f"the camera gives {size[0]} x {size[1]} pixels: ask for these with --width and --height")
    return kept


def expose(camera, cv2, seconds):
    """Exposure time in the camera's unit of 100 us; what it took, seconds."""
    camera.set(cv2.CAP_PROP_EXPOSURE, round(seconds * 1e4))
    for _ in range(SETTLE_FRAMES):
        camera.read()
    return camera.get(cv2.CAP_PROP_EXPOSURE) * 1e-4


def frame_bytes(camera, form, size):
    """Bytes of one frame as the camera sent them."""
    fine, image = camera.read()
    if not fine:
        raise CaptureError("the camera sends no frame: close other programs that use it, and try another --device")
    data = image.tobytes()
    if form == "yuyv" and len(data) != 2 * size[0] * size[1]:
        raise CaptureError(f"a frame has {len(data)} bytes and not those of YUYV: this OpenCV converts; use v4l2-ctl")
    if form == "mjpeg":
        end = data.rfind(b"\xff\xd9")  # the driver's buffer is longer than the frame
        if data[:2] != b"\xff\xd8" or end < 0:
            raise CaptureError("a frame is no JPEG: this OpenCV converts; use v4l2-ctl")
        data = data[: end + 2]
    return data


def take(camera, form, size, folder, count):
    """Write `count` frames into a folder, numbered after those that it has."""
    folder.mkdir(parents=True, exist_ok=True)
    first = len(list(folder.glob("*" + SUFFIX[form])))
    for k in range(first, first + count):
        (folder / f"{k:03d}{SUFFIX[form]}").write_bytes(frame_bytes(camera, form, size))
    return first + count


def write_notes(out, form, size, seconds, options):
    """capture.toml; a second run must not change what the first one fixed."""
    lines = [f'format = "{form}"', f"width_px = {size[0]}", f"height_px = {size[1]}", f"exposure_s = {seconds:.6f}"]
    for key in ("columns", "rows", "square_m"):
        if getattr(options, key) is not None:
            lines.append(f"board_{key} = {getattr(options, key)}")
    lines += ["", "[controls]", f"gain = {options.gain}", f"sharpness = {options.sharpness}"]
    notes = out / "capture.toml"
    old = notes.read_text() if notes.exists() else ""
    same = ("format", "width_px", "gain", "sharpness")
    for line in lines if old else ():
        if line.split(" =")[0] in same and line not in old.splitlines():
            raise CaptureError(f"{notes} has another {line.split(' =')[0]}: take a new folder, --out")
    boards = [line for line in old.splitlines() if line.startswith("board_")]
    lines[4:4] = [line for line in boards if line.split(" =")[0] not in "\n".join(lines)]
    out.mkdir(parents=True, exist_ok=True)
    notes.write_text("\n".join(lines) + "\n")


def run(options, camera, cv2, sleep=time.sleep, tell=print):
    """One step; returns the number of frames that were written."""
    size = (options.width, options.height)
    kept = set_up(camera, cv2, options.format, *size, options.gain, options.sharpness)
    for meaning in kept:
        tell(f"note: the camera did not take '{meaning}'; set it with v4l2-ctl and look at it there")
    if options.warm_up_s:
        tell(f"warming up for {options.warm_up_s:.0f} s")
        sleep(options.warm_up_s)
    series = {"exposure": EXPOSURES, "dark-exposure": EXPOSURES}.get(options.step, (options.exposure_s,))
    written = 0
    write_notes(options.out, options.format, size, options.exposure_s, options)
    for seconds in series:
        taken_s = expose(camera, cv2, seconds)
        timed = len(series) > 1
        place = options.step + (f"/{taken_s:.4f}" if timed else f"/{options.level}" if options.step == "flat" else "")
        one_by_one = options.step in ("chessboard", "edge")
        take(camera, options.format, size, options.out / place, 1 if one_by_one else options.frames)
        written += 1 if one_by_one else options.frames
        tell(f"{options.out / place}: {1 if one_by_one else options.frames} frames at {taken_s:.4f} s")
    return written


def parsed(arguments):
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    steps = ("dark", "flat", "exposure", "dark-exposure", "edge", "chessboard")
    parser.add_argument("--step", choices=steps, required=True)
    parser.add_argument("--level", default="00", help="name of the flat level")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--format", choices=tuple(FOURCC), default="yuyv")
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=720)
    parser.add_argument("--exposure-s", type=float, default=0.0167)
    parser.add_argument("--gain", type=int, default=0)
    parser.add_argument("--sharpness", type=int, default=24)
    parser.add_argument("--columns", type=int, help="inner corners of the chessboard")
    parser.add_argument("--rows", type=int)
    parser.add_argument("--square-m", type=float)
    parser.add_argument("--device", type=int, default=0)
    parser.add_argument("--warm-up-s", type=float, default=0.0)
    return parser.parse_args(arguments)


def main(arguments=None):
    """Run one step with a real camera."""
    import cv2

    options = parsed(arguments)
    camera = cv2.VideoCapture(options.device, cv2.CAP_V4L2)
    try:
        if not camera.isOpened():
            raise CaptureError(f"no camera at /dev/video{options.device}; name another with --device")
        run(options, camera, cv2)
    except CaptureError as fault:
        print(f"capture: {fault}", file=sys.stderr)
        return 2
    finally:
        camera.release()
    return 0


if __name__ == "__main__":
    sys.exit(main())
