"""What plugins are checked on: a sample problem with its offline phase, and a made-up run."""
