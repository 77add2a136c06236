"""The solution after the decision: noise, scale and GPS fixes estimated together with the poses."""
