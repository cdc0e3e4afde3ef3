"""Pure functions from our messages to ROS messages.

`make(type, **fields)` is `Types.make`. Frames are those of REP-105, axes and units of REP-103.
"""
