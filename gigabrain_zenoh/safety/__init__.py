"""Monitors that say whether and how fast the body may move, one file for each.

`step` puts them side by side, `node` is the process.

It may import bus, gate, geometry, host and runtime; never perception, vision, mapping or
navigation: what cameras measure it judges by its own code, in `depth`.
Launch, recording and qa may import it.
"""
