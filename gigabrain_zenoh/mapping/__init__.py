"""Maps from laser scans and odometry. A library: it knows no bus.

It may import config, geometry, host and kernels.
Perception and the tools that read maps may import it.
"""
