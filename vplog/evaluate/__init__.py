"""Figures against ground truth: of trajectories, closures and retrieved places."""
