"""The output folder: may it be written, does it hold another data set, is there room."""

from __future__ import annotations

import shutil
from pathlib import Path

from phibench.datasets import layout
from phibench.datasets.errors import DatasetError
from phibench.datasets.files import remove_temporary, write_bytes
from phibench.datasets.info import info_text, read_info
from phibench.datasets.plan import Plan
from phibench.datasets.schema import DatasetInfo
from phibench.datasets.sums import damaged

_AMBIENT_BYTES_PX = 12.0  # three noisy float32 planes do not compress
_TRUTH_BYTES_PX = 13.5  # ten float32 planes; what is outside the mirror compresses to nothing
_PREVIEW_BYTES_PX = 2.8
_SPOT_BYTES = 8192
_RESERVE = 1.1


def bytes_needed(plan: Plan) -> int:
    """Disk space of a data set, about, a little too much."""
    pixels = plan.rig.camera.width_px * plan.rig.camera.height_px
    views = len(plan.poses) * pixels * (_AMBIENT_BYTES_PX + _TRUTH_BYTES_PX + _PREVIEW_BYTES_PX)
    pairs = len(plan.pairs) * (2 * _SPOT_BYTES + 0.5 * pixels * _PREVIEW_BYTES_PX)
    return int(_RESERVE * (views + pairs))


def claim(out: Path, name: str, recipe_hash: str) -> None:
    """Make the folder, refuse one that holds something else, try to write to it, clear what a killed run left.

    Raises
    ------
    DatasetError
        With one sentence that says what to do.
    """
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out} is a file; give a folder")
    _refuse_other(out, name, recipe_hash)
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_bytes(out / ".phibench-probe", b"").unlink()
        remove_temporary(out)
    except OSError as error:
        raise DatasetError(f"cannot write to {out}: {error.strerror or error}; give another folder") from error


def check_disk(out: Path, needed: int) -> None:
    """Refuse when the disk has no room; what the folder holds already will be replaced and counts as free."""
    held = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    free = shutil.disk_usage(out).free
    if needed > free + held:
        text = f"about {_megabytes(needed)} are needed and {_megabytes(free + held)} are free at {out}"
        raise DatasetError(f"{text}; free some space or give a folder on another disk")


def is_complete(out: Path, info: DatasetInfo) -> bool:
    """Whether the folder holds exactly this data set, made by this code, undamaged; the commit does not count."""
    if not (out / layout.SUMS).is_file() or not (out / layout.INFO).is_file():
        return False
    return _content(read_info(out)) == _content(info) and not damaged(out)


def _content(info: DatasetInfo) -> str:
    provenance = {key: value for key, value in info.provenance.items() if key != "commit"}
    return info_text(info.model_copy(update={"provenance": provenance}))


def _refuse_other(out: Path, name: str, recipe_hash: str) -> None:
    if not out.is_dir() or not any(out.iterdir()):
        return
    if not (out / layout.INFO).is_file():
        raise DatasetError(f"{out} is not empty and holds no data set; give an empty or a new folder")
    held = read_info(out)
    if held.recipe_sha256 != recipe_hash:
        made = "" if held.name != name else ", made from a recipe with other values"
        raise DatasetError(f"{out} holds another data set ('{held.name}'{made}); give another folder or delete it")


def _megabytes(count: int) -> str:
    return f"{count / 1e6:.0f} MB"
