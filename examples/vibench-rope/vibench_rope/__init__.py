"""An elastic rope over an obstacle, and a primal strategy to go with it."""

from __future__ import annotations

from pathlib import Path

STUDY = Path(__file__).with_name("rope.toml")
"""The study `rope`."""
