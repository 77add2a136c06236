"""The tests that every recogniser of vplog passes.

pip install . ./examples/recogniser_plugin pytest
pytest examples/recogniser_plugin
"""

from mean_colours import MeanColours

from vplog.testing.recogniser_contract import RecogniserContract


class TestMeanColours(RecogniserContract):
    settings = MeanColours(blocks=4)
