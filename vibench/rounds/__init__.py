"""Seconds of queries, high-fidelity solutions and short offline stages, timed in rounds."""
