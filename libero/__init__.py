"""Import paths of the original benchmark, for code that was written for it; adapters to `libero_env`."""
