"""Examines the product: the fault suite, benchmarks and the conformance kit of drivers.

It may import everything except cli, also the drivers.
Only the commands may import it.
"""
