"""The results file: its columns, its database, and tables and checks derived from them."""
