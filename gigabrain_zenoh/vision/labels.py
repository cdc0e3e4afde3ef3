"""Names and numbers of classes that nets recognise."""

# of the shipped net, in the order of its outputs
CLASSES = ("cube", "ball", "cylinder", "can", "box", "person", "robot", "charger", "door")

# COCO numbers its 80 classes up to 90; nets such as RF-DETR answer by these numbers
LEFT_OUT = {12, 26, 29, 30, 45, 66, 68, 69, 71, 83}
COCO_IDS = tuple(number for number in range(1, 91) if number not in LEFT_OUT)
