"""Formulations of the reduced problem other than the mixed one, registered through entry points like the strategies."""
