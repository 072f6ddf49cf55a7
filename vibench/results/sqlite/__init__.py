"""The SQLite file under the results: how it is opened and read, what its columns hold, digests of what was written."""
