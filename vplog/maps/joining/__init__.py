"""Drives that share places in one pose graph, for joint runs and for maps: pairs, closures between them, the solve."""
