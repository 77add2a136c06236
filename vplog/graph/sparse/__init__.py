"""Sparse linear algebra of large pose graphs: multifrontal Cholesky, its solves and selected inversion."""
