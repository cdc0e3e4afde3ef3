"""The process that chooses where to drive: behaviours, tasks, and the navigator.

It may import bus, config, gate, geometry, host, kernels and navigation.
Client (formats of tasks), launch, commands and qa may import it.
"""
