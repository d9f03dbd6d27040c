"""Self-tests of the renderer: an image with known values, and a kernel that an LLVM must compile and run.

The image shows a grey ball in the middle of an evenly bright sky. A convex diffuse body of albedo a in a sky of
radiance L has the radiance a L everywhere, whatever its shape and wherever one looks from. Beside it one sees L itself.

The kernel holds the instruction that LLVM 15 and 16 cannot select on AVX-512 machines (a floating-point minimum), a
loop over lanes, a gather, a scatter-add and a sum, and compares with plain arithmetic. It runs in a process of its own,
which it may abort. Run as a program, the module exits with 0 if the test passes.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from phibench.render.setup.llvm_library import load
from phibench.render.setup.variant import activate

ALBEDO = 0.6
SKY = 0.9
SIZE_PX = 16
SAMPLES = 256
TOLERANCE = 0.02
"""Of the ball's mean over 4 x 4 pixels, relative. One sample scatters by 21 %, 4096 by 0.33 %: six times that."""


def prove_image() -> int:
    """Render, compare, and say on stderr what differs."""
    fault = compare(render(activate()))
    if fault:
        print(fault, file=sys.stderr)
    return 1 if fault else 0


def render(mitsuba: ModuleType) -> npt.NDArray[np.float32]:
    """Render the ball, and return one colour plane, shape (SIZE_PX, SIZE_PX)."""
    scene = mitsuba.load_dict(_scene(mitsuba))
    return np.array(mitsuba.render(scene, spp=SAMPLES, seed=0), dtype=np.float32)[:, :, 1]


def compare(image: npt.NDArray[np.float32]) -> str:
    """Fault of the image in one line; empty if there is none."""
    middle = slice(SIZE_PX // 2 - 2, SIZE_PX // 2 + 2)
    ball, sky = float(image[middle, middle].mean()), float(image[0, 0])
    if not abs(ball / (ALBEDO * SKY) - 1) <= TOLERANCE:
        return f"the ball has the radiance {ball:.4f} instead of {ALBEDO * SKY:.4f}"
    # The sky is seen directly, so without noise: only the rounding of the film's weights is left.
    if not abs(sky / SKY - 1) <= 1e-4:
        return f"the sky has the radiance {sky:.6f} instead of {SKY:.6f}"
    return ""


def _scene(mitsuba: ModuleType) -> dict[str, Any]:
    """Describe a ball of radius 1 seen from a distance of 5; it fills about half the width of the image."""
    film = {
        "type": "hdrfilm",
        "width": SIZE_PX,
        "height": SIZE_PX,
        "rfilter": {"type": "box"},
        "component_format": "float32",
    }
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": {
            "type": "perspective",
            "fov": 45,
            "to_world": mitsuba.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0]),
            "film": film,
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY}},
        "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}}},
    }


SIZE = 4099
"""Not a multiple of any vector width, so that the last packet is a partial one."""
CEILING = 1000.0


def prove_kernel(path: str) -> int:
    """Run the kernel with the library at `path`, which DRJIT_LIBLLVM_PATH names as well."""
    load(Path(path))
    got, expected = kernel(), plain()
    if got != expected:
        print(f"the test kernel gave {got} instead of {expected}", file=sys.stderr)
        return 1
    return 0


def kernel() -> tuple[float, float, float]:
    """Compute with Dr.Jit: the sum of minima, of maxima, and one cell of a histogram."""
    import drjit as dr
    from drjit.llvm import Float, UInt32

    dr.set_thread_count(1)
    index = dr.arange(UInt32, SIZE)
    value = Float(index)
    histogram = dr.zeros(Float, 3)
    dr.scatter_add(histogram, dr.gather(Float, value, index), index % 3)
    low = dr.sum(dr.minimum(value, CEILING), axis=None)
    high = dr.sum(dr.maximum(dr.floor(dr.sqrt(value)), 8.0), axis=None)
    return float(low[0]), float(high[0]), float(histogram[1])


def plain() -> tuple[float, float, float]:
    """Compute the same without Dr.Jit. Every partial sum is an integer below 2^24, exact in single precision."""
    low = sum(min(float(i), CEILING) for i in range(SIZE))
    high = sum(max(float(int(i**0.5)), 8.0) for i in range(SIZE))
    return low, high, float(sum(i for i in range(SIZE) if i % 3 == 1))


if __name__ == "__main__":
    sys.exit(prove_kernel(sys.argv[1]) if len(sys.argv) > 1 else prove_image())
