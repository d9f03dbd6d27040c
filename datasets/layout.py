"""Where the files of a data set are, relative to its folder, with forward slashes."""

from __future__ import annotations

INFO = "dataset.json"
MANIFEST = "manifest.jsonl"
TABLE = "manifest.parquet"
RECIPE = "recipe.toml"
SUMS = "SHA256SUMS"
RUN = "run.json"
CONTACT_SHEET = "contact_sheet.png"
NOT_DATA = (SUMS, RUN, CONTACT_SHEET)
"""Files that SHA256SUMS does not list: itself, the diary of the run, and what `show` draws."""


def view_file(pose_id: str, name: str) -> str:
    """File of a mirror pose; `name` is "ambient", "truth" or "preview"."""
    return f"views/{pose_id}/{name}.{'png' if name == 'preview' else 'exr'}"


def spot_file(sample_id: str, position: str) -> str:
    """Spot layer of a sample at a stroke position."""
    return f"spots/{sample_id}-{position}.exr"


def preview_file(sample_id: str) -> str:
    """Picture of a sample: down and up side by side, laser on."""
    return f"previews/{sample_id}.png"
