"""The paper's experiments on any drives of one route: what recognises, at what price, and why."""
