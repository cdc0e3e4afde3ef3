"""The process that turns intents into velocity commands, and teleoperation's into the same.

It may import bus, gate, geometry and runtime.
Launch, commands and qa may import it.
"""
