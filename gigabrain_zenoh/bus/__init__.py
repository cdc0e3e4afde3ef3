"""Typed topics and services over a transport: Zenoh, or a network in memory.

It may import config, host, logs and security.
Every process may import it; mapping, navigation, gate and geometry may not.
"""
