"""Shared equipment of the fault tests: robots, broken processes, bad networks, hostile messages.

It must not import rows.
Rows and the suite import it; hostile messages serve other tests as well.
"""
