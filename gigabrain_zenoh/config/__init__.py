"""Settings of all processes, and YAML files read into them, faults named by file and line.

It may import host.
Every room above may import it.
"""
