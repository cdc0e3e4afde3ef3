"""Bodies: a folder each, with `robot.yaml`, its model, and both ends of its wire.

Drivers import `driver.base`, `lidars.base`, `links` and `kinematics`, emulators also `emulators`.
Nothing imports a body; it is found by name, through `DRIVERS`.
"""
