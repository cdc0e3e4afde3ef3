"""Rights: a fleet's authority, identities for its hosts, and a router's access rules.

It may import config and host. It knows no bus.
Bus, runtime and the rooms above may import it.
"""
