"""Cameras: the process that publishes pictures, its sources, and a model of depth errors.

Imports `driver`; rendered sources also import `sim`. `CAMERAS` of the package above lists the
sources by name.
"""
