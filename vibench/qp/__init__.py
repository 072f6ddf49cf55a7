"""Quadratic programs: one call for all QP solvers, their settings, KKT verification, and what an accuracy allows."""
