"""Recognisers against each other, on pairs of drives or image sets that have a truth."""
