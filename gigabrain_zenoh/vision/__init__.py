"""Vision: finds things and obstacles in pictures and depth of cameras. A pure library.

It may import `config`, `geometry`, `host` and `kernels`. It may be imported by `perception`,
`recognition`, and by processes of cameras. It knows no bus, no clock and no process; cv2 is
imported where it is needed only.
"""
