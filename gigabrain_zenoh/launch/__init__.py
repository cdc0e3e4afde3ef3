"""Starts a robot: the table of processes, deployment files, `up` and `demo`.

It may import all rooms but cli and qa, and names drivers only in the table of processes.
Commands and qa may import it.
"""
