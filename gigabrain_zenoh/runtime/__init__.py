"""How a process lives: its frame, supervision, deployments, the router, audit and discovery.

It may import bus, config, host and security.
The rooms above, and the drivers, may import it.
"""
