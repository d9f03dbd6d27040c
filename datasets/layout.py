"""Where the files of a data set are, relative to its folder, with forward slashes."""

from __future__ import annotations

import re

INFO = "dataset.json"
MANIFEST = "manifest.jsonl"
TABLE = "manifest.parquet"
RECIPE = "recipe.toml"
RIGS = "rigs.jsonl"
SUMS = "SHA256SUMS"
LIGHT_MAP = "lightmap.npz"
RUN = "run.json"
LOG = "log.jsonl"
JOURNAL = "journal.txt"
LOCK = ".phibench-lock"
WORKING = ".phibench-working"
CONTACT_SHEET = "contact_sheet.png"
SENSITIVITIES = "sensitivities.parquet"
NOT_DATA = (SUMS, RUN, LOG, JOURNAL, LOCK, WORKING, CONTACT_SHEET, SENSITIVITIES)
"""Files that SHA256SUMS does not list: itself, the diaries of the run, locks, and what is computed from it all."""

_TASK_FILE = re.compile(
    r"lightmap\.npz|views/[^/]+/(ambient|truth)\.exr|views/[^/]+/preview\.png|spots/[^/]+-(down|up)\.exr|previews/[^/]+\.png"
)


def view_file(pose_id: str, name: str) -> str:
    """File of a mirror pose; `name` is "ambient", "truth" or "preview"."""
    return f"views/{pose_id}/{name}.{'png' if name == 'preview' else 'exr'}"


def spot_file(sample_id: str, position: str) -> str:
    """Spot layer of a sample at a stroke position."""
    return f"spots/{sample_id}-{position}.exr"


def preview_file(sample_id: str) -> str:
    """Picture of a sample: down and up side by side, laser on."""
    return f"previews/{sample_id}.png"


def is_task_file(name: str) -> bool:
    """Whether a file is called as what tasks write: the light map, a view's, a spot's or a preview's."""
    return _TASK_FILE.fullmatch(name) is not None
