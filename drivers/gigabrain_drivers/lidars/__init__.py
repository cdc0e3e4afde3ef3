"""Lidars that any body can carry: `scan: {driver: NAME, port: ...}` in a link of its file."""

# name in a robot's file -> "module:class"; imported only when used
SCAN_SOURCES = {
    "ld06": "gigabrain_drivers.lidars.ld.source:Ld06",
    "ld19": "gigabrain_drivers.lidars.ld.source:Ld19",
    "lds01": "gigabrain_drivers.lidars.lds.lds01:Lds01",
    "lds02": "gigabrain_drivers.lidars.ld.source:Lds02",
    "lds03": "gigabrain_drivers.lidars.lds.lds03:Lds03",
    "rplidar": "gigabrain_drivers.lidars.rplidar.source:Rplidar",
}
