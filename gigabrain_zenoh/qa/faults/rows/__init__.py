"""The fault tests, grouped by subject. Each module lists its rows in `ROWS`.

A row holds its test function and its limits.
Only `faults.suite` and tests may import it.
"""
