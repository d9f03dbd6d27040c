"""Errors of recipes and data sets; every message is for the person at the terminal."""

from __future__ import annotations


class DatasetError(ValueError):
    """A data set that cannot be made, read or trusted."""


class RecipeError(DatasetError):
    """A recipe with faults; the message has one line per fault."""
