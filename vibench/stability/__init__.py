"""Inf-sup constants over the span and the cone of reduced multipliers."""
