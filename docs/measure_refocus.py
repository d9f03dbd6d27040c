"""Focal length and error of D of a lens that was turned after its calibration. Run `python docs/measure_refocus.py`.

A thin lens of 4.0 mm on the pixels of a C310 was calibrated while it was focused far away. It is turned to 0.46 m and
to 0.23 m, the mirror's virtual image. Spots are those of the paper's 25 experiments, 0.50 m above the floor.
"""

from __future__ import annotations

from dataclasses import replace

from phibench.estimator.geometry.paper_depth import load_published
from phibench.scenes.rig import Rig
from phibench.studies.misalignment.refocus import FOCUS_M, LENS_M, OLD, OUTLINE, refocus, thin_lens

HEIGHT_M = 0.50


def main() -> None:
    """Print the table."""
    rig = replace(Rig(), camera=thin_lens(Rig().camera, LENS_M))
    places = [(row.real_depth_m, row.baseline_m) for row in load_published()]
    print(f"{'focus':>8s} {'f':>10s} {'change':>8s} {OLD:>17s} {OUTLINE:>29s}")
    print(f"{'far':>8s} {rig.camera.fx_px:7.1f} px")
    for focus_m in FOCUS_M:
        row = refocus(rig, focus_m, places, HEIGHT_M)
        change, old, outline = (100.0 * value for value in (row.relative, row.rms(OLD), row.rms(OUTLINE)))
        print(f"{focus_m:6.2f} m {row.focal_px:7.1f} px {change:+6.2f} % {old:10.2f} % of D {outline:22.3f} % of D")


if __name__ == "__main__":
    main()
