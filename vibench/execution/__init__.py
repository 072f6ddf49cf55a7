"""Running a study: the graph of stages, worker processes under supervision, and what is recorded when."""
