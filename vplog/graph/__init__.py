"""The pose graph: factors and their noise, robust optimisation, covariances, and a certificate of the solution."""
