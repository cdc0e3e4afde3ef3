"""A base on a line of text, described in YAML: options, protocol, driver and emulator."""
