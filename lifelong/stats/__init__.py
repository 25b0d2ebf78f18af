"""Statistics: metrics of a run, intervals, methods compared over seeds."""
