"""Threads, processes and timing."""
