"""A live bridge to viewers that speak the protocol of Foxglove, such as Lichtblick."""
