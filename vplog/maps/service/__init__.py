"""A map over HTTP: held open, read only, and exchanged for its newest state while it answers."""
