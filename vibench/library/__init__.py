"""Studies, runs and reduced models from Python: what the command line does, as functions."""
