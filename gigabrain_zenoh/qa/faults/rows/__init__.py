"""The fault tests, grouped by subject. `@fault_row` makes a row of each test function.

A row holds the test, its number, its robot and its limits.
Only `faults.suite` and tests may import it.
"""
