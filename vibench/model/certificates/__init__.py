"""Certificates of reduced solutions at online cost: derived and evaluated in `bounds`, prepared in the others."""
