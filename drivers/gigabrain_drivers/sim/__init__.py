"""Simulated bodies: MuJoCo physics, worlds, sensors and the truth about them. No bus in here."""
