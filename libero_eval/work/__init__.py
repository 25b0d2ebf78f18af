"""An evaluation as units of work that several processes share, and that a killed process leaves to the others."""
