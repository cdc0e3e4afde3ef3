"""Monitors that decide whether and how fast the body may move, one file for each.

`step` combines them, `node` is the process.

It may import bus, gate, geometry, host and runtime; never perception, vision, mapping or
navigation: it judges depth pictures by its own code, in `depth`.
Launch, recording and qa may import it.
"""
