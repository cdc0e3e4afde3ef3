"""Names of what the shipped net recognises, in the order of its outputs."""

CLASSES = ("cube", "ball", "cylinder", "can", "box", "person", "robot", "charger", "door")
