"""Contents of folders."""

import json
from pathlib import Path

from phibench.datasets.store import schema
from phibench.datasets.store.checksums import data_files


def contents(out: Path) -> dict[str, bytes]:
    return {name: (out / name).read_bytes() for name in (*data_files(out), schema.CHECKSUMS, schema.JOURNAL)}


def done(out: Path) -> list[str]:
    """Tasks that the log says were done, in no order."""
    lines = (out / schema.LOG).read_text().splitlines()
    return sorted(json.loads(line)["task"] for line in lines)
