"""TurtleBot3's OpenCR: the board on its line, and the driver of the body that it moves."""
