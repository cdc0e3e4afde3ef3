"""Alpha, a quadruped behind a TCP port: driver, protocol and firmware emulator."""
