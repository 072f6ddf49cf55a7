"""Twins of the figures of Niakh et al. (2022): what is published of each, what a run has, and how the two compare."""
