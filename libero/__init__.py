"""The original benchmark's import paths, for code written against it: adapters to `libero_env`, nothing of their own."""
