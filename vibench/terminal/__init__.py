"""What a terminal or a notebook shows: tables, lines and the progress of a run."""
