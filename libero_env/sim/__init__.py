"""One compiled scene and what is computed on it: stepping, control, state, truth of goals, observations, pictures."""
