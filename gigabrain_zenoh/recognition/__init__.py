"""The process that recognises things and tags in camera pictures.

It may import bus, config, geometry, host, runtime and vision; cv2 is imported here, by vision.
Launch, commands and qa may import it.
"""
