"""Loop closures: candidates, their geometric verification, and poses against landmarks with covariance."""
