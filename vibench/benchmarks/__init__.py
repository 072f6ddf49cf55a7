"""Benchmarks of plugins with pytest-benchmark: what is timed, what it reached, and files of benchmarks compared."""
