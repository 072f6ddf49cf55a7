"""High-fidelity solutions: a primal–dual active set method and the KKT systems it solves."""
