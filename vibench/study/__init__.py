"""Studies: the registry of plugins and their options, study files, and the matrix of cells."""

import os

# Pydantic would look for plugins of its own in the entry points of all distributions, and raise if one is unreadable.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
