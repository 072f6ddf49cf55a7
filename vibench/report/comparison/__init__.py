"""Comparison of runs: the runs that are compared, differences of their cells, and what they amount to."""
