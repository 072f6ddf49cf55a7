"""Benchmarks of plugins: what is timed, what it reached, and files of pytest-benchmark written and compared."""
