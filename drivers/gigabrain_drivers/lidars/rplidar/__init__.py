"""Slamtec RPLIDARs: source, protocol and emulator."""
