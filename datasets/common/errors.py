"""Errors of recipes and data sets; every message is for the person at the terminal."""

from __future__ import annotations


class DatasetError(ValueError):
    """A data set that cannot be made, read or trusted."""


class RecipeError(DatasetError):
    """A recipe with faults; the message has one line per fault."""


class RefusedSampleError(DatasetError):
    """A sample that cannot be made, while others can: an answer that is not certain, or too much noise."""


class IncompleteError(DatasetError):
    """A run that has finished all samples but those that were refused; the message has one line for each of these."""
