"""Many drives at once, on this machine or on a Ray cluster, into one map."""
