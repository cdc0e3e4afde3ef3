"""Bodies that are not there: real bytes on a pty or a TCP port, with physics behind them."""

# driver of a link, or of its scan source -> the device that answers it, imported only when used
DEVICES = {
    "alpha": "gigabrain_drivers.bodies.alpha.emulator:Alpha",
    "line": "gigabrain_drivers.bodies.line.emulator:LineBase",
    "ld06": "gigabrain_drivers.lidars.ld.emulator:LdDevice",
    "ld19": "gigabrain_drivers.lidars.ld.emulator:LdDevice",
    "lds01": "gigabrain_drivers.lidars.lds.emulator:Lds01Device",
    "lds02": "gigabrain_drivers.lidars.ld.emulator:Lds02Device",
    "lds03": "gigabrain_drivers.lidars.lds.emulator:Lds03Device",
    "rplidar": "gigabrain_drivers.lidars.rplidar.emulator:RplidarDevice",
    "opencr": "gigabrain_drivers.bodies.turtlebot3.emulator:OpenCr",
}
