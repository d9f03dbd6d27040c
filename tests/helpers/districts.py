"""The districts of the library."""

DISTRICTS = ("scenes", "render", "datasets", "estimator", "calibration", "benchmark", "robot", "studies")
"""Folders of the library, each above the ones before it; `phibench/` holds links to them, and the command line."""
