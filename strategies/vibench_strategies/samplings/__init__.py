"""Sampling strategies: how the training and the validation parameters of a study are chosen."""
