"""Lidars that any body can carry: `scan: {driver: NAME, port: ...}` in a link of its file."""
