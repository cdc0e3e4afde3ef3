"""The process that recognises things and tags in the pictures of a body's cameras.

It may import bus, config, geometry, host, runtime and vision; cv2 is imported here, by vision.
Launch, commands and qa may import it.
"""
