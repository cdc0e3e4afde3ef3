"""The OpenCR board of TurtleBot3 Burger and Waffle: driver, protocol and emulator."""
