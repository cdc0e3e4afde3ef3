"""Views of a robot for people: the operator page, Foxglove, teleoperation and the demo's view.

It may import all rooms below it: client, diagnostics, recording, runtime and what these may.
Launch, commands and qa may import it.
"""
