"""The process that turns intents into velocity commands, and teleoperation's into the same.

It may import bus, gate and geometry.
Launch, commands and qa may import it.
"""
