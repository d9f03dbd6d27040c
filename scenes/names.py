"""Advice for a misspelt name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(name: str, known: Iterable[str]) -> str:
    """Advice for an unknown name: the nearest known one, and what is known."""
    names = list(known)
    guesses = close_names(name, names)
    guess = f"did you mean '{guesses[0]}'? " if guesses else ""
    return f"{guess}known: {', '.join(names)}"


def close_names(name: str, known: Iterable[str]) -> list[str]:
    """Nearest known name, if one is near: a list of one or none."""
    return difflib.get_close_matches(name, list(known), 1, 0.5)
