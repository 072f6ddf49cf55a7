"""The figures of Niakh et al. (2022), drawn again: what is published, what a run has, and how they compare."""
