"""Drives that share places in one pose graph, of a joint run and of a map."""
