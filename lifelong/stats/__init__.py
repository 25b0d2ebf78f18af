"""Statistics: metrics of a run, intervals, methods compared over seeds, policies compared episode by episode, power."""
