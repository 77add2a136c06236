"""Verbs of the command line, without their printing."""
