"""Several drives, or pieces of one, in one pose graph."""
