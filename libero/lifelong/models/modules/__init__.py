"""The parts that the original's policies are put together from."""
