"""Drives of a map that share places, in one pose graph."""
