"""Bodies: one folder each, with `robot.yaml`, model, driver and emulator.

Drivers import `driver.base`, `lidars.base`, `links` and `kinematics`, emulators also `emulators`.
Nothing imports a body. `DRIVERS` of the package above lists them by name.
"""
