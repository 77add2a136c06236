"""Sparse linear algebra of large pose graphs; knows nothing of drives."""
