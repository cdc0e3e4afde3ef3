"""The process that chooses where to drive: behaviours, tasks, and the navigator.

It may import bus, config, gate, geometry, host, kernels, logs, navigation and runtime.
Client (formats of tasks), launch, commands and qa may import it.
"""
