"""What a study works on: data sets rendered from recipes, kept between runs and shared between studies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from phibench.datasets.errors import DatasetError
from phibench.datasets.read import Dataset, open_finished
from phibench.datasets.recipe_file import find_recipe


@dataclass(frozen=True)
class Material:
    """Where data sets are, and how many processes render them.

    Parameters
    ----------
    folder : Path
        Data sets lie in it under the names of their recipes; what is finished there is not rendered again.
    console : Console
        For progress.
    workers : int, optional
        Processes; by default one per core.
    """

    folder: Path
    console: Console
    workers: int | None = None

    def dataset(self, recipe: str | Path, samples: int | None = None) -> Dataset:
        """Data set of a recipe, rendered if need be.

        Parameters
        ----------
        recipe : name of a shipped recipe, or a TOML file
        samples : number instead of the recipe's, for recipes with `[random]`

        Raises
        ------
        DatasetError
            If the recipe has faults, rendering fails, or Mitsuba is not installed and the data set is not there.
        """
        name = find_recipe(recipe).stem if samples is None else f"{find_recipe(recipe).stem}-{samples}"
        target = self.folder / name
        try:
            from phibench.datasets.make import make

            make(recipe, target, workers=self.workers, console=self.console, samples=samples)
        except ImportError as error:
            if (error.name or "").split(".")[0] not in ("mitsuba", "drjit"):
                raise
            if not target.is_dir():
                raise DatasetError(
                    f"the study needs the data set {name}, which is not in {self.folder}, and Mitsuba is not "
                    "installed: pip install 'phibench[render]', or put a rendered one there (--data)"
                ) from error
        return open_finished(target)
