"""Run with `pytest`: the tests that every recogniser of vplog passes."""

from mean_colours import MeanColours

from vplog.testing.recogniser_contract import RecogniserContract


class TestMeanColours(RecogniserContract):
    settings = MeanColours(blocks=4)
