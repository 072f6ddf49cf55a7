"""Reduced models: Galerkin projection, hyper-reduction, errors and error bounds."""
