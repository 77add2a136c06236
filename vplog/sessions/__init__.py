"""Several drives in one pose graph."""
