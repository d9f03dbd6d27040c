"""Whether Mitsuba can render on a CUDA GPU here: asks the driver, creates nothing on the device."""

from __future__ import annotations

import ctypes
import os
import sys

_DRIVER = {"linux": "libcuda.so.1", "win32": "nvcuda.dll"}
_OPTIX = {"linux": "libnvoptix.so.1", "win32": "nvoptix.dll"}
_PLACES = {  # Dr.Jit's own variables for libraries in odd places
    "DRJIT_LIBCUDA_PATH": _DRIVER,
    "DRJIT_LIBOPTIX_PATH": _OPTIX,
}


def has_gpu() -> bool:
    """Whether a CUDA device, its driver and OptiX (which traces Mitsuba's rays there) are at hand."""
    libraries = [_load(os.environ.get(name) or names.get(sys.platform)) for name, names in _PLACES.items()]
    return all(libraries) and _devices(libraries[0]) > 0


def _load(name: str | None) -> ctypes.CDLL | None:
    try:
        return None if name is None else ctypes.CDLL(name)
    except OSError:
        return None


def _devices(driver: ctypes.CDLL | None) -> int:
    """Number of devices; 0 where the driver does not answer."""
    count = ctypes.c_int(0)
    if driver is None or driver.cuInit(0) != 0 or driver.cuDeviceGetCount(ctypes.byref(count)) != 0:
        return 0
    return count.value
