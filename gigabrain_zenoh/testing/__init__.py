"""Fixtures for tests of a robot or a driver: buses in memory, a brain in memory, real processes.

It may import everything. Only tests may import it, those of other packages included:
`pytest_plugins = ["gigabrain_zenoh.testing.fixtures"]` in a conftest.py gives all fixtures.
"""
