"""Values on the axes of a study that are no plugins and have a meaning of their own."""

OWN = "own"
"""Name of the training and the validation set that a problem itself has."""

CERTIFIED = "certified"
"""Assembly of queries that are assembled as reduced ones, and have certificates."""
