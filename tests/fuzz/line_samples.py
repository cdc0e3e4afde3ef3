"""Valid sample bytes of each device's protocol."""

from typing import Any

from gigabrain_drivers.bodies.alpha import protocol as alpha
from gigabrain_drivers.bodies.line.protocol import Template
from gigabrain_drivers.bodies.turtlebot3 import protocol as opencr
from gigabrain_drivers.kinematics.legs import Senses
from gigabrain_drivers.lidars.ld import protocol as ld
from gigabrain_drivers.lidars.lds import lds01, lds03
from gigabrain_drivers.lidars.rplidar import protocol as rplidar
from gigabrain_drivers.lidars.rplidar.scan_formats import encode_dense, encode_express, encode_node

TWELVE = (1.0,) * 12


def state_of_alpha(**changes: Any) -> alpha.State:
    three = ((0.1, 0.2, 0.3),) * 4
    senses = Senses(
        joints=three, rates=three, contacts=(True, False, True, False),
        orientation=(0.0, 0.0, 0.0, 1.0), angular_velocity=(0.0, 0.0, 0.1),
        linear_acceleration=(0.0, 0.0, 9.81),
    )  # fmt: skip
    now = alpha.State(1000, 0, 0, 0, 25.2, 1.0, 80.0, senses, TWELVE, TWELVE)
    return now._replace(**changes)


def samples(template: Template) -> dict[str, bytes]:
    """Return valid bytes of each protocol, by its name."""
    ranges = tuple(range(500, 512))
    five = tuple(lds03.Lds03Sample(float(n), 500 + n, 80, False) for n in range(5))
    nodes = [encode_node(n * 10.0, 500.0, quality=20, begins=n % 36 == 0) for n in range(80)]
    dense = [encode_dense(n * 40.0 % 360, (500,) * 40, begins=n == 0) for n in range(12)]
    express = [encode_express(n * 40.0 % 360, (500,) * 32, begins=n == 0) for n in range(12)]
    status = opencr.status(opencr.ID, bytes(opencr.LENGTH))
    return {
        "alpha": b"".join(
            alpha.encode_state(state_of_alpha(milliseconds=1000 + 10 * n), n + 1) for n in range(3)
        ) + alpha.encode_stop(4),
        "dynamixel": status + opencr.velocity(0.1, 0.2).frame + opencr.ping(opencr.ID),
        "ld": b"".join(
            ld.encode(
                ld.LdFrame(3600, at % 36000, (at + 800) % 36000, ranges, (200,) * 12, at // 90)
            )
            for at in range(0, 84 * 900, 900)
        ),
        "lds01": b"".join(
            lds01.encode(lds01.Lds01Packet(n % 60, 300.0, (100,) * 6, (500,) * 6))
            for n in range(122)
        ),
        "lds03": b"".join(
            lds03.encode(lds03.Lds03Packet(n % 8 == 0, 10.0 * (n % 8 == 0), five))
            for n in range(20)
        ),
        "line": template.encode({"battery_voltage": 12.0, "wheel_left_position": 1.0}) * 3,
        "rplidar": rplidar.answer(rplidar.HEALTH, bytes(3))
        + rplidar.descriptor(rplidar.STANDARD, 5, endless=True) + b"".join(nodes),
        "rplidar dense": rplidar.descriptor(rplidar.DENSE, 84, endless=True) + b"".join(dense),
        "rplidar express": rplidar.descriptor(rplidar.EXPRESS, 84, endless=True)
        + b"".join(express),
        "rplidar request": rplidar.request(rplidar.SCAN) + rplidar.express_request(2),
    }  # fmt: skip
