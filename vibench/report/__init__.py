"""Evaluation of runs: findings, HTML report, figures, comparison of runs, replay and export of programs."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
