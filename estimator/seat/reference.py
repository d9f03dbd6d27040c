"""A method that was found: what it is called, where it is, and which version of it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class Reference:
    """A method that is there.

    Attributes
    ----------
    name : str
        Of the method: what a score is filed under.
    kind : "file", "built-in" or "package"
    place : str
        Absolute path of the file; module of the built-in registry; ``module:function`` of an entry point.
    function : str
        Function in the file; "" otherwise.
    sha256 : str or None
        Of the file, or of the code behind the built-in methods; None for packages.
    version : str or None
        Distribution and version of a package.
    """

    name: str
    kind: Literal["file", "built-in", "package"]
    place: str
    function: str = ""
    sha256: str | None = None
    version: str | None = None

    def document(self) -> dict[str, str | None]:
        """Provenance, as JSON can hold it; of a file its name alone, not where it lies."""
        place = Path(self.place).name if self.kind == "file" else self.place
        return {**asdict(self), "place": place}
