"""Settings of all processes, and YAML files read into them; errors name file and line.

It may import host.
Every room above may import it.
"""
