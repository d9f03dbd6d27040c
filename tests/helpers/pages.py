"""Interactive pages as tests read them: packed planes, the JSON inside, and what a browser shows."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
import subprocess
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

CHROMIUM = next((name for name in ("chromium", "chromium-browser", "google-chrome") if shutil.which(name)), "")
NEEDS_BROWSER = pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")


def unpacked(text: str, width: int, height: int) -> np.ndarray:
    """Codes of a packed plane, in NumPy."""
    low, high = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(2, height, width).astype(int)
    return np.cumsum(low + 256 * high, axis=1) % 65536


def page_json(path: Path) -> dict[str, Any]:
    found = re.search(r'<script type="application/json"[^>]*>(.*?)</script>', path.read_text(encoding="utf-8"), re.S)
    assert found
    return json.loads(found[1])


def browsed(page: Path, address: str, tmp_path: Path, *options: str) -> tuple[dict[str, str], str]:
    """Attributes of the read-out after the address was opened in Chromium, and what the console said."""
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--virtual-time-budget=20000", "--enable-logging=stderr"]
    command += [f"--user-data-dir={tmp_path / 'browser'}", *options, "--dump-dom", f"{page.as_uri()}#{address}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert 'data-ready="yes"' in done.stdout, done.stderr[-2000:]
    readout = re.search(r'<div id="readout"([^>]*)>', done.stdout)
    assert readout
    attributes = {k: html.unescape(v) for k, v in re.findall(r'data-([\w-]+)="([^"]*)"', readout[1])}
    return attributes, "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)
