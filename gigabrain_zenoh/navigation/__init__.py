"""Finding a way, and driving it."""
