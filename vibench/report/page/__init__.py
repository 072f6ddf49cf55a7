"""What the HTML report is made of: its tables as compact data, its plots to work with, and its pictures."""
