"""The places and references of a map that recognition can do without are found, and left out of a new map."""
