"""Speed, always as a ratio of two things measured side by side in one run: `python -m tests.benchmarks`.

And `backend`: the error of pose graph back ends on random worlds, beside an oracle's.

They take minutes and are no part of the tests; tests/test_benchmarks.py runs each of them once on next to nothing.
"""
