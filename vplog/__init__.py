"""vplog: from a recorded drive to an optimised trajectory, with loop closures found by bag of bounding boxes."""

__version__ = "0.1.0"
