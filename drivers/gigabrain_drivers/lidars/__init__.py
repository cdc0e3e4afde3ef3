"""Lidars that any body can carry: `scan: {driver: NAME, port: ...}` in a link of its file.

Sources import `driver.base` and `links`, emulators also `emulators`. Drivers import `base`. The
other modules are found by name, through `LIDARS`.
"""
