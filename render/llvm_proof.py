"""The kernel that an LLVM must compile and run before it is used. Runs in a process of its own, which it may abort.

It holds the instruction that LLVM 15 and 16 cannot select on AVX-512 machines (a floating-point minimum), a loop over
lanes, a gather, a scatter-add and a sum, and compares with plain arithmetic.
"""

import sys
from pathlib import Path

from phibench.render.llvm_library import load

SIZE = 4099
"""Not a multiple of any vector width, so that the last packet is a partial one."""
CEILING = 1000.0


def main(path: str) -> int:
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
    sys.exit(main(sys.argv[1]))
