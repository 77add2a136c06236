"""Tests for packages that bring a method of their own: what every recogniser must do, run by their pytest."""
