"""The stages of cells whose formulation is a plugin: the formulation on its offline phase, and its queries."""
