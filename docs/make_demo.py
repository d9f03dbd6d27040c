"""Make the frames set that `phibench demo` scores, from five samples of bench-dev.

    phibench dataset make bench-dev --samples 120 --out out/dev
    python docs/make_demo.py out/dev random-0000{09,12,16,04,05} --out benchmark/pair_sets/demo

In turn the spot is saturated, hidden in one image, beside a lamp, found, and faint. Without names of samples the script
lists what each sample is, and its room.
"""

from __future__ import annotations

import argparse
import math
import shutil
import tempfile
from pathlib import Path

from phibench.benchmark.export.export_make import export
from phibench.benchmark.export.pair_rows import ExportRequest
from phibench.benchmark.pair_sets.dataset_pairs import dataset_pairs
from phibench.datasets.frames.frame_request import FrameOptions
from phibench.datasets.read import open_finished
from phibench.datasets.store.checksums import checksums_text
from phibench.datasets.store.files import sha256, write_text
from phibench.datasets.store.pair_files import FRAMES_SET, PAIRS
from phibench.estimator.interface import Pair
from phibench.estimator.spots.image_planes import linear_planes

PRESET = "mjpeg"


def listed(folder: Path) -> None:
    """Print one line for each sample."""
    pairs = dataset_pairs(open_finished(folder), PRESET, 1)
    for number, (pair, truth) in enumerate(pairs):
        row = pairs.dataset[truth.sample_id].row
        words = [f"{truth.sample_id:24} {row.room} D {truth.depth_m:6.2f} m"]
        for name in ("down", "up"):
            spot = getattr(truth, name)
            if spot.visible:
                light = _lamp(pair, name, spot.uv_px)
                words.append(f"{name}: snr {spot.snr:6.1f}{' saturated' if spot.saturated else ''} lamp {light:.2f}")
            else:
                words.append(f"{name}: {spot.cause}")
        print(number, "  ".join(words))


def _lamp(pair: Pair, name: str, uv_px: tuple[float, float]) -> float:
    """Brightest red light within 15 px of the spot with the laser off, full scale 1; NaN without such a frame."""
    image = getattr(pair, f"{name}_off")
    if image is None:
        return math.nan
    u, v = (round(x) for x in uv_px)
    red = linear_planes(image, pair.card)[0]
    return float(red[max(v - 15, 0) : v + 16, max(u - 15, 0) : u + 16].max())


def made(folder: Path, samples: tuple[str, ...], out: Path) -> None:
    """Write the frames set of some samples."""
    with tempfile.TemporaryDirectory() as work:
        laser_off = open_finished(folder).recipe.frames.laser_off
        wanted = ExportRequest("frames", FrameOptions(PRESET), laser_off=laser_off, samples=samples, scored=True)
        export(folder, wanted, Path(work) / "set", workers=1)
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(Path(work) / "set" / "frames", out / "frames")
        for name in (FRAMES_SET, PAIRS):
            shutil.copy(Path(work) / "set" / name, out / name)
    files = [path for path in out.rglob("*") if path.is_file()]
    write_text(out / "SHA256SUMS", checksums_text({p.relative_to(out).as_posix(): sha256(p) for p in files}))
    print(f"{out}: {sum(path.stat().st_size for path in files) / 1e6:.2f} MB")


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("samples", nargs="*")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    if given.samples:
        made(given.folder, tuple(given.samples), given.out)
    else:
        listed(given.folder)


if __name__ == "__main__":
    main()
