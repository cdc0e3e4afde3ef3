"""Global plans over a costmap, and the local planner (MPPI). A library: it knows no bus.

It may import geometry and kernels.
Decision and qa may import it.
"""
