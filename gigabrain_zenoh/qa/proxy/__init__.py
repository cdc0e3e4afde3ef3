"""A bad network on purpose: a proxy that delays, cuts and damages what goes through it.

It imports no other room.
The fault suite and `gigabrain proxy` use it.
"""
