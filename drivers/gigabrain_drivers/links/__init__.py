"""Bytes to and from bodies: serial lines and TCP connections that keep themselves open."""
