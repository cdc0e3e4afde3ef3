"""Bodies that are not there: real bytes on a pty or a TCP port, with physics behind them."""

# driver of a link, or of its scan source -> the device that answers it, imported only when used
DEVICES = {
    "alpha": "gigabrain_drivers.emulators.alpha:Alpha",
    "line": "gigabrain_drivers.emulators.line_base:LineBase",
    "ld06": "gigabrain_drivers.emulators.ld:LdDevice",
    "ld19": "gigabrain_drivers.emulators.ld:LdDevice",
    "lds01": "gigabrain_drivers.emulators.lds:Lds01Device",
    "lds02": "gigabrain_drivers.emulators.lds:Lds02Device",
    "lds03": "gigabrain_drivers.emulators.lds:Lds03Device",
    "rplidar": "gigabrain_drivers.emulators.rplidar:RplidarDevice",
    "opencr": "gigabrain_drivers.emulators.opencr:OpenCr",
}
