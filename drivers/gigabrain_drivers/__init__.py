"""Bodies: adding one means a folder in `bodies`, and for a new kind of link a line in DRIVERS."""

# name in a robot's file -> "module:class"; imported only when used, so a body's SDK stays optional
DRIVERS = {
    "alpha": "gigabrain_drivers.bodies.alpha.driver:AlphaDriver",
    "line": "gigabrain_drivers.bodies.line.driver:LineDriver",
    "mock": "gigabrain_drivers.bodies.mock.driver:MockBody",
    "mujoco": "gigabrain_drivers.sim.driver:MujocoDriver",
    "opencr": "gigabrain_drivers.bodies.turtlebot3.driver:OpenCrDriver",
}
