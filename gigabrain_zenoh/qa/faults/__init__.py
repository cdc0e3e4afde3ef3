"""The fault suite: each row breaks a robot in one way, and judges it by limits.

`rows` contains the tests, grouped by subject; the other modules are shared by them.
Only the `gigabrain faults` command and tests may import it.
"""
