"""Life cycle of processes: the way onto the bus, services, supervision, router and audit.

It may import bus, config, host, logs and security.
The rooms above, and the drivers, may import it.
"""
