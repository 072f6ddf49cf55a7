"""Reduced bases: POD, projection on cones, supremizers, nested enrichments, lazy greedy selection."""
