"""How a process lives: the way onto the bus, services, supervision, the router, and the audit.

It may import bus, config, host, logs and security.
The rooms above, and the drivers, may import it.
"""
