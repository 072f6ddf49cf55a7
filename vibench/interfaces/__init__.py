"""What plugins are: problems, dual and primal strategies, what they exchange, and its validation."""
