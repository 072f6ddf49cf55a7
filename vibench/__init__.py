"""vibench: a benchmark framework for reduced-order models of parametrised variational inequalities."""
