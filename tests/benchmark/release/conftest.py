"""The release that the tests of this folder share."""

from pathlib import Path

import pytest
from helpers.inline_workers import InlineWorkerPool
from helpers.small_release import FILMS, SMALL, STARTER, Made, ask

from phibench.benchmark.release.release_make import release
from phibench.benchmark.release.release_parts import ReleasePart, content_sha256
from phibench.benchmark.sealed.sealed_set import seal


@pytest.fixture(scope="session")
def made(smallest_dataset: Path, film_windows: Path, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Data sets that are there are used; the sealed one is rendered with a secret seed. Read only."""
    folder = tmp_path_factory.mktemp("release")
    recipe = folder / "hidden.toml"
    recipe.write_text(SMALL.text() + '\n[frames]\npresets = ["mjpeg"]\n', encoding="utf-8")
    sealed = ReleasePart("hidden", recipe, "sealed", content_sha256(recipe.read_text(encoding="utf-8")))
    request = ask(folder, [SMALL, sealed, FILMS, STARTER], use=[smallest_dataset, film_windows])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("phibench.datasets.make.WorkerPool", InlineWorkerPool)
        return Made(request, release(request, seal))
