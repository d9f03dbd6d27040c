"""Claims of fits of faint spots on raw pixels: `measure_faint_claims.py [--spots 300]`.

Run from the repository root. Spots of one signal to noise over a known flat room, in places drawn evenly over the
mosaic's cell; each fit begins where `detect` might have seen it. Prints, by blur, room and signal to noise, how many
fits answer, the rms pull by the curvature at the fit's place, by what `raw_maximum_likelihood` claims, and of the mean
of the posterior (`joint_fit`, `measure`), how many are beyond 5 claimed sigma of each, and how many fits are 3 px off.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from helpers.faint_spots import faint_spots

SNR = (5.0, 7.0, 10.0, 13.0, 20.0)
SCENES = ((0.8, 20.0), (0.8, 300.0), (0.45, 20.0))  # blur in pixels, electrons of the room


def main() -> None:
    """Print a line per scene and signal to noise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spots", type=int, default=300)
    given = parser.parse_args()
    print("| blur, room | SNR | fits | curvature | claimed | posterior | beyond 5 sigma | beyond 3 px | no claim |")
    print("|---|---|---|---|---|---|---|---|---|")
    for blur, room in SCENES:
        for snr in SNR:
            found = faint_spots(snr, blur, room, given.spots)
            each = (found.curvature, found.claimed, found.posterior)
            pulls = " | ".join(f"{np.sqrt(squares.mean() / 2.0):.2f}" for squares in each)
            far = ", ".join(str(int((squares > 25.0).sum())) for squares in each)
            print(
                f"| {blur:g} px, {room:g} e- | {snr:g} | {len(found.apart_px)} of {given.spots} | {pulls} | {far} | "
                f"{int((found.apart_px > 3.0).sum())} | {found.unclaimed} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
