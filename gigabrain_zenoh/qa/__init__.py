"""Examines the product: the fault suite, benchmarks and the conformance kit of drivers.

It may import everything but cli, the drivers included.
Only the commands may import it.
"""
