"""The lidars LDS-01 and LDS-03 of TurtleBot3: sources, protocols and emulators."""
