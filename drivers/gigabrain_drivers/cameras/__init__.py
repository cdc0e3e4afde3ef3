"""Cameras: the process that publishes their pictures, its sources, and a model of their errors.

Imports `driver` and, in the sources that simulate, `sim`. Sources are found by name, through
`CAMERAS` of the package above.
"""
