"""Short form of results: a title with lines of names and values, in a terminal and in a notebook."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

_FEW = 4  # values that are shown one by one


class ShortForm:
    """Result whose `repr` is a short table; a notebook shows the same, and not all of its fields."""

    def _title(self) -> str:
        return type(self).__name__

    def _shown(self) -> Mapping[str, Any]:
        """Values by their names, as `short` takes them."""
        return {}

    def __repr__(self) -> str:
        return "\n".join([self._title(), *_lines({name: short(value) for name, value in self._shown().items()})])

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"


def _lines(shown: Mapping[str, str]) -> Iterator[str]:
    width = max(map(len, shown), default=0) + 2
    return (f"  {name:{width}}{value}".rstrip() for name, value in shown.items())


def short(value: Any) -> str:
    """Few words for a value: numbers with six digits, arrays of more than four values by shape and range."""
    if value is None:
        return "-"
    if isinstance(value, bool | str):
        return str(value)
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, tuple | list) and len(value) <= _FEW:
        return f"({', '.join(map(short, value))})"
    return str(value)


def _array(values: np.ndarray[Any, Any]) -> str:
    if values.ndim == 0:
        return short(values.item())
    if values.size <= _FEW and values.ndim == 1:
        return f"({', '.join(short(one) for one in values.tolist())})"
    text = f"{' x '.join(map(str, values.shape))} {values.dtype}"
    if values.dtype.kind not in "iuf" or not np.isfinite(values).any():
        return text
    return f"{text}, {short(np.nanmin(values).item())} to {short(np.nanmax(values).item())}"
