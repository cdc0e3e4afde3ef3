"""Simulates a bad network: a proxy that delays, cuts and damages its connections.

It imports no other room.
The fault suite and `gigabrain proxy` use it.
"""
