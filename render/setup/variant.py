"""Mitsuba, activated once per process: the variant (LLVM, or CUDA where it is asked for), then one Dr.Jit thread.

Dr.Jit adds floating-point numbers with atomics, in whatever order its threads come, so that two runs agree to the last
bit only with one thread. Work is spread over processes instead. The variant is global to the process and never changed.
The search for a GPU asks the driver and creates nothing on the device.
"""

from __future__ import annotations

import ctypes
import os
import sys
from types import ModuleType

from phibench.render.setup.child_program import GET_LIBRARY, MISSING_LIBRARY
from phibench.render.setup.llvm import ENVIRONMENT as LLVM_ENVIRONMENT
from phibench.render.setup.llvm import find_llvm, use_llvm

_DRIVER = {"linux": "libcuda.so.1", "win32": "nvcuda.dll"}
_OPTIX = {"linux": "libnvoptix.so.1", "win32": "nvoptix.dll"}
_PLACES = {  # Dr.Jit's own variables for libraries in odd places
    "DRJIT_LIBCUDA_PATH": _DRIVER,
    "DRJIT_LIBOPTIX_PATH": _OPTIX,
}


def has_gpu() -> bool:
    """True if a CUDA device, its driver and OptiX (which traces Mitsuba's rays there) are at hand."""
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


CUDA, LLVM = "cuda_ad_rgb", "llvm_ad_rgb"
VARIANTS = {"llvm": LLVM, "cuda": CUDA}
"""Mitsuba's name of a variant by the short one."""
ENVIRONMENT = "PHIBENCH_VARIANT"
"""Names a variant for everything, over what the code asks for: "llvm", "cuda", or Mitsuba's name of another."""

THREADS = 1
"""Dr.Jit counts the calling thread: 1 means that it works alone, without a pool."""


class VariantError(RuntimeError):
    """Mitsuba cannot be used as asked. The message is one sentence."""


def asked_variant() -> str:
    """Mitsuba's name of the variant that `PHIBENCH_VARIANT` asks for; LLVM where it asks for none.

    A GPU is never taken unasked: a data set's bytes must not depend on a driver.
    """
    asked = os.environ.get(ENVIRONMENT, "")
    return VARIANTS.get(asked, asked) or LLVM


def renders_with() -> dict[str, str | None]:
    """Variant and version of LLVM that this process renders with, without loading either.

    Raises
    ------
    LlvmError
        If the variant needs an LLVM and there is none.
    """
    variant = _active() or asked_variant()
    return {"variant": variant, "llvm": find_llvm().label if variant.startswith("llvm") else None}


def activate(variant: str | None = None) -> ModuleType:
    """Import Mitsuba, set the variant and one thread, and return the module.

    Parameters
    ----------
    variant : str, optional
        Mitsuba's name of a variant; PHIBENCH_VARIANT overrules it. Without either, what this process renders with, or
        else LLVM.

    Raises
    ------
    VariantError
        If Mitsuba is not installed, does not have the variant, runs another one in this process, was imported with
        an LLVM that nobody chose, or is to use a GPU that does not answer.
    LlvmError
        If the variant needs an LLVM and there is none.
    """
    wanted = asked_variant() if os.environ.get(ENVIRONMENT) else variant or _active() or LLVM
    mitsuba = _import_mitsuba(needs_llvm=wanted.startswith("llvm"))
    active = mitsuba.variant()
    if active == wanted:
        _settle()
        return mitsuba
    if active is not None:
        raise VariantError(
            f"this process renders with {active} and cannot change to {wanted}: start another process for that."
        )
    if wanted not in mitsuba.variants():
        known = ", ".join([*VARIANTS, *(name for name in mitsuba.variants() if name not in VARIANTS.values())])
        raise VariantError(f"Mitsuba has no variant {wanted}: choose one of {known}.")
    if wanted == CUDA and not has_gpu():
        raise VariantError(
            "CUDA is asked for, and no NVIDIA driver with OptiX and a device answers: install one, or unset "
            f"{ENVIRONMENT} (or leave --variant out) to render with LLVM."
        )
    mitsuba.set_variant(wanted)
    _settle()
    return mitsuba


def _active() -> str | None:
    """Variant of this process, if Mitsuba is imported and has one."""
    mitsuba = sys.modules.get("mitsuba")
    return None if mitsuba is None else mitsuba.variant()


def _import_mitsuba(*, needs_llvm: bool) -> ModuleType:
    if needs_llvm and "drjit" not in sys.modules:
        use_llvm()
    elif needs_llvm and not os.environ.get(LLVM_ENVIRONMENT):
        # Dr.Jit reads the variable when it is imported; without it, it has taken the first LLVM that it met.
        raise VariantError(
            "Dr.Jit was imported before its LLVM was chosen: call `phibench.render.setup.variant.activate` before any "
            "import of mitsuba or drjit."
        )
    try:
        import mitsuba
    except ModuleNotFoundError as error:
        raise VariantError("Mitsuba is not installed: run `pip install 'phibench[render]'`.") from error
    except (ImportError, NameError) as error:  # drjit goes on after an ImportError, and stumbles over a name
        cause = error.__context__ or error
        raise VariantError(
            f"Mitsuba cannot be loaded ({cause}){f': {GET_LIBRARY}' if MISSING_LIBRARY in str(cause) else ''}."
        ) from error
    return mitsuba


def _settle() -> None:
    """Set what Mitsuba and Dr.Jit keep for the whole process."""
    import drjit
    import mitsuba

    drjit.set_thread_count(THREADS)
    drjit.set_log_level(drjit.LogLevel.Error)
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
