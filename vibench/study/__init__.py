"""Studies: the registry of plugins and their options, study files, and the matrix of cells."""
