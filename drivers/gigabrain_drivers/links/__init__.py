"""Bytes to and from bodies: serial lines and TCP connections that keep themselves open."""

from gigabrain_drivers.links.link import Link, LinkProblem
from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_drivers.links.tcp_link import TcpLink

__all__ = ["Link", "LinkProblem", "SerialLink", "TcpLink"]
