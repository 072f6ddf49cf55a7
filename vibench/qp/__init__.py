"""Quadratic programs: solvers and their settings, KKT verification, and a bound on how far two solutions may differ."""
