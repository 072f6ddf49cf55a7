"""High-fidelity solutions: the primal–dual active set method and its KKT systems."""
