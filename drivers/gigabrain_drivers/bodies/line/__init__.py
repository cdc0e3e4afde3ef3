"""A base on a text line that YAML describes: options, protocol, driver and emulator."""
