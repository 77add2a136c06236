"""Pose graphs of several drives, and of the pieces of one drive."""
