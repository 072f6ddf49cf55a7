"""The SQLite file under the results: how it is opened, what its columns can hold, and digests of what was written."""
