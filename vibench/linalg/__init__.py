"""Linear algebra: dense and sparse factorisations, Schur complements, and inner products given by a Gram matrix."""
