"""LDROBOT lidars (LD06, LD19, LDS-02): source, protocol and emulator."""
