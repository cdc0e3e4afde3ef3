"""The fault suite: breaks a robot in the ways of its rows, and judges it by their limits.

`rows` holds the tests, grouped by subject; the modules beside it are their shared equipment.
Only the `gigabrain faults` command and tests may import it.
"""
