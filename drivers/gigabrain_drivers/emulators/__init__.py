"""Bodies that are not there: real bytes on a pty or a TCP port, with physics behind them.

May import every room here but bodies. The emulators of bodies and lidars import `base`.
"""
