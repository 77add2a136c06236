"""Atomic replacement of a file, as the writers import it."""

from vplog.scratch import replacing

__all__ = ["replacing"]
