"""What goes wrong with a method before its first pair; every message is for the person at the terminal."""

from __future__ import annotations


class MethodError(ValueError):
    """A method that cannot be found, loaded or started; one sentence."""
