"""Starts a robot: the table of processes, their settings, `up` and `demo`.

It may import all rooms but cli and qa, and names the drivers in the table of processes alone.
Commands and qa may import it.
"""
