"""The process that turns scans into a map, a pose and tracked obstacles.

It may import bus, config, geometry, host, kernels, mapping and runtime.
Launch, commands and qa may import it.
"""
