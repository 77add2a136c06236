"""Refinement after the decision: noise, scale and GPS fixes are estimated together with the poses."""
