"""Samples on which plugins are checked: a problem with a reduced model of it, and the results of a made-up run."""
