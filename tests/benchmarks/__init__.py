"""Benchmarks with pytest-benchmark (`bench_*.py`, `pytest tests/benchmarks`), and scripts that compare whole runs."""
