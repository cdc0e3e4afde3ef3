"""A body in memory, for tests and benchmarks."""
