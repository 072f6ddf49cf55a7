"""Plugins: their registry, their options, and the fingerprints of classes and objects given in Python."""

import os

# Pydantic would look for plugins of its own in the entry points of all distributions, and raise if one is unreadable.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
