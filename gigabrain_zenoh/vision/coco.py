"""Numbers of COCO's 80 classes among its 90: nets such as RF-DETR answer by these."""

LEFT_OUT = {12, 26, 29, 30, 45, 66, 68, 69, 71, 83}
COCO_IDS = tuple(number for number in range(1, 91) if number not in LEFT_OUT)
