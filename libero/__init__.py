"""Import paths of the original benchmark, for code written against it: adapters to `libero_env` only."""
