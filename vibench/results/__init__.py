"""The results file: its columns, the database, and what is derived from its tables."""
