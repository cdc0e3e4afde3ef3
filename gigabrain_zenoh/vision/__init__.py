"""Vision: finds things and obstacles in pictures and depth of cameras. A pure library.

It may import `config`, `geometry`, `host` and `kernels`. It may be imported by `perception`,
`recognition`, and by processes of cameras. It uses no bus, no clock and no process. Only modules
that need cv2 import it.
"""
