"""Bodies: a folder each, with `robot.yaml`, its model, and the driver of its wire."""
