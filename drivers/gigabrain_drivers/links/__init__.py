"""Serial lines, TCP connections and CAN buses to bodies, which reconnect after a loss.

Imports no other room of this package and no bus. Drivers, lidars and other packages import it.
"""

from gigabrain_drivers.links.link import Link, LinkProblem
from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_drivers.links.tcp_link import TcpLink

__all__ = ["Link", "LinkProblem", "SerialLink", "TcpLink"]
