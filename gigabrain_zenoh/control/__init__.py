"""The process that turns intents, and teleoperation, into commands for base and joints.

It may import bus, gate, geometry and runtime.
Launch, commands and qa may import it.
"""
