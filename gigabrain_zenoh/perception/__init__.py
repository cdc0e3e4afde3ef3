"""The process that turns scans into a map, a pose and tracked obstacles.

It may import bus, config, geometry, host, kernels, mapping and runtime.
Diagnostics, launch, commands and qa may import it.
"""

FIND_IT = (
    "turn the robot with `gigabrain teleop`, show its camera a known tag, "
    "or set its pose with `gigabrain pose X Y`"
)
