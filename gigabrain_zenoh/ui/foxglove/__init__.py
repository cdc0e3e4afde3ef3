"""Bridge to viewers of Foxglove's protocol, such as Lichtblick."""
