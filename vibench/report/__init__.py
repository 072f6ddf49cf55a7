"""Evaluation of runs: findings, HTML report, figures, comparison of runs, replay and export of programs."""

from vibench import surface

__getattr__, __dir__, __all__ = surface(__name__, __file__)
