"""Interfaces of plugins: problems, dual and primal strategies, their data, and its validation."""
