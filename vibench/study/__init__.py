"""Studies: their files, parameter sets, and the matrix of cells."""

import vibench.plugins  # noqa: F401  keeps pydantic from reading the entry points of other distributions
