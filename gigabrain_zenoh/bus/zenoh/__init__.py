"""The transport over Zenoh: sessions that come back, and their configuration.

It may import the bus and what the bus may import.
Only `transport`, `config` and `session` are used outside, by processes and commands.
"""
