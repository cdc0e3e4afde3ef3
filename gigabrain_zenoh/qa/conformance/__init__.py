"""The driver author's kit: what every driver has to do, checked on any of them by name."""
