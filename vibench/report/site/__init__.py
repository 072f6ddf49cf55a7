"""The static site of published runs: its pages, what they cite and lock, and the folder they are written into."""
