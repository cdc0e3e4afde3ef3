"""The Python API to a running robot: drive, stop, send it to places.

It may import bus, decision (formats of tasks), geometry, runtime and security.
Diagnostics, ui, commands, drivers and users' programs may import it.
"""
