"""The values of report.html; `results/templates/report.html` lays them out."""

from vplog.data import Verdict

TAKEN = (Verdict.ACCEPTED, Verdict.DIRECTION_ONLY)
"""Verdicts of closures that the solve used, at least in part."""
