"""What `gigabrain bench` measures, and against what."""
