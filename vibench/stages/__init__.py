"""Stages of a computation and their artefacts, from snapshots to the queries of a cell."""
