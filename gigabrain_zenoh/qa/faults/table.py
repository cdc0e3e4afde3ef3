"""The table of fault tests: what breaks, and by what figures the robot is judged.

Speeds are 0.26 m/s where nothing else is said. Times are the robot's own (ticks of 20 ms) or the
simulation's, and those marked `wall` a person's; travel and contacts are the physics' truth. A body
that brakes at 1 m/s2 from 0.26 m/s is at rest 260 ms later, and 100 ms are its own lag: so much
later than it brakes it is at zero. A figure must not be exceeded by any run that counts.
"""

from collections.abc import Iterable

from gigabrain_zenoh.errors import unknown
from gigabrain_zenoh.qa.faults.fault import Fault

PROCESS, DEATHS, LINK, NETWORK = "process", "deaths", "body_link", "network"
DATA, CLOCK, LOAD, SECURITY, ESTOP = "data", "clock", "load", "security", "estop"
ERRAND, FROZEN, EXTREMES = "errand", "frozen", "one_message"
STOP = "brakes after <= 120 ms, zero after <= 480 ms, travel <= 0.1 m"
STILL = "moved again <= 0.005 m"  # before a person has enabled it again
STALE = "stale executed <= 0"  # commands that rest on data older than 250 ms

FAULTS: tuple[Fault, ...] = (
    Fault(1, "decision-killed", PROCESS, "sim", f"{STOP}, {STILL}"),
    Fault(2, "decision-frozen", PROCESS, "sim", f"{STOP}, {STILL}"),
    Fault(3, "frozen-and-thawed", PROCESS, "sim", f"{STALE}, {STILL}"),
    Fault(4, "control-killed-or-frozen", PROCESS, "sim", f"{STOP}, {STALE}, {STILL}"),
    Fault(
        5, "perception-killed-or-frozen", PROCESS, "sim",
        f"brakes after <= 320 ms, zero after <= 680 ms, travel <= 0.15 m, {STILL}",
    ),
    Fault(
        6, "safety-killed-or-frozen", PROCESS, "sim",
        f"brakes after <= 250 ms, zero after <= 610 ms, travel <= 0.1 m, {STILL}, "
        "enabled without it <= 0",
    ),
    Fault(
        7, "gate-killed", DEATHS, "line",
        f"motors zero after <= 150 ms, not latched at start <= 0, enabled while latched <= 0, "
        f"commands of the old boot obeyed <= 0, {STILL}",
    ),
    Fault(
        8, "driver-killed", DEATHS, "line", "motors zero after <= 150 ms, travel <= 0.1 m",
    ),
    Fault(
        9, "one-part-of-decision-hangs", PROCESS, "",
        "brakes after <= 300 ms, zero after <= 660 ms, travel <= 0.15 m",
    ),
    Fault(
        10, "crash-loop", DEATHS, "",
        "starts <= 5, wait too short <= 0 s, enabled without it <= 0, cpu added <= 5 %",
    ),
    Fault(
        11, "every-process-and-pair-killed", DEATHS, "line",
        f"idle after <= 10 s, {STILL}",
    ),
    Fault(
        12, "serial-unplugged", LINK, "serial",
        f"reported after <= 100 ms, motors zero after <= 150 ms, back after <= 2 s, {STILL}, "
        "deaths <= 0",
    ),
    Fault(
        13, "serial-noise", LINK, "serial",
        "wrong commands per million <= 0, lines lost after garbage <= 2, deaths <= 0",
    ),
    Fault(
        14, "tcp-frozen", LINK, "tcp",
        f"reported after <= 250 ms, old commands obeyed <= 0, {STILL}",
    ),
    Fault(
        15, "tcp-cut", LINK, "tcp",
        f"safe after RST <= 100 ms, safe after FIN <= 100 ms, safe after half-open <= 250 ms, "
        f"back after <= 1 s, {STILL}",
    ),
    Fault(16, "telemetry-frozen", LINK, "serial", "noticed after <= 500 ms"),
    Fault(
        17, "motors-disobey", LINK, "serial",
        "runaway latched after <= 500 ms, stuck wheel noticed after <= 500 ms",
    ),
    Fault(
        18, "router-killed", NETWORK, "sim",
        f"brakes after <= 120 ms, session after <= 3 s wall, {STILL}",
    ),
    Fault(19, "router-frozen", NETWORK, "sim", f"{STALE}, {STILL}"),
    Fault(
        20, "network-partition", NETWORK, "",
        f"stops in a gap of 100 ms <= 0, brakes after <= 120 ms, {STALE}, {STILL}",
    ),
    Fault(
        21, "two-commanders-across-a-partition", NETWORK, "sim", "executed of the first <= 0",
        loads=True,
    ),
    Fault(
        22, "latency-jitter-loss", NETWORK, "",
        "stops at 100 ms round trip <= 0, moves above 150 ms <= 0, start-stop rate <= 1 Hz",
    ),
    Fault(
        23, "viewer-frozen", NETWORK, "sim",
        "control period p99 above calm <= 20 ms, put p99 <= 20 ms wall",
    ),
    Fault(24, "bit-flips", NETWORK, "", "corrupt payloads accepted <= 0", ("keys",)),
    Fault(
        25, "duplicated-and-reordered", NETWORK, "sim", "effects beyond the first copy <= 0",
    ),
    Fault(
        26, "hostile-values", DATA, "sim",
        "wheel effects <= 0, deaths <= 0, zero after NaN <= 20 ms",
    ),
    Fault(
        27, "full-reversals", DATA, "sim",
        "acceleration told over its limit <= 0.1 %, acceleration measured over it <= 1 %",
    ),
    Fault(28, "blind-lidar", DATA, "", "brakes after <= 300 ms, zero after <= 660 ms"),
    Fault(29, "thin-obstacles", DATA, "", "contacts <= 0"),
    Fault(
        30, "obstacle-at-stopping-distance", DATA, "",
        "contacts <= 0, missing to a gap of 3 cm <= 0 m, false stops <= 1 %, resume after <= 0.3 s",
    ),
    Fault(31, "battery-and-temperature", DATA, "", "wrong actions <= 0"),
    Fault(
        32, "recorder-killed", DATA, "",
        "lost <= 0.5 s, earlier messages unreadable <= 0, control delayed <= 20 ms", ("recorder",),
    ),
    Fault(33, "wall-clock-jumps", CLOCK, "", "stops <= 0"),
    Fault(34, "stamps-of-other-times", CLOCK, "", "taken for fresh <= 0"),
    Fault(35, "hosts-with-other-clocks", CLOCK, "", "stops <= 0, tick age error <= 1 ms"),
    Fault(36, "counters-wrap", CLOCK, "", "falsely accepted <= 0"),
    Fault(
        37, "cpu-hogs", LOAD, "sim",
        "gate tick late p99.9 <= 40 ms wall, brakes after <= 250 ms, zero after <= 610 ms, "
        "missed e-stops <= 0",
        loads=True,
    ),
    Fault(
        38, "flood", LOAD, "sim",
        "cpu of the driver <= 50 % wall, memory grown <= 50 MB, latched after <= 100 ms, "
        "e-stop p99 <= 50 ms wall, flooder unnamed <= 0",
        loads=True,
    ),
    Fault(
        39, "soak", "soak", "sim",
        "unexplained stops <= 0, open files grown <= 0, lost <= 0, "
        "perception grows <= 1 MB/h long, driver grows <= 1 MB/h long, "
        "safety grows <= 1 MB/h long, router grows <= 1 MB/h long",
    ),
    Fault(
        40, "unauthorised-publisher", SECURITY, "",
        "wheels moved <= 0, denials unseen <= 0, open ports besides the router <= 0", ("keys",),
    ),
    Fault(
        41, "replayed-traffic", SECURITY, "sim", "accepted <= 0, e-stops refused after it <= 0",
    ),
    Fault(
        42, "idle-and-random-connections", SECURITY, "sim",
        "control period p99 above calm <= 20 ms, operator connects after <= 5 s wall, "
        "router deaths <= 0",
        loads=True,
    ),
    Fault(
        43, "e-stop-pressed", ESTOP, "sim",
        "unlatched <= 0, latched after <= 100 ms, answer p99 <= 50 ms wall, "
        "answer <= 100 ms wall, zero p99 <= 50 ms wall, zero <= 100 ms wall, travel <= 0.06 m, "
        "confirmed by nobody <= 0",
    ),
    Fault(
        44, "release-and-re-enable", ESTOP, "sim",
        "wrongly released <= 0, moved while latched <= 0.005 m, speed after enabling <= 0.02 m/s",
    ),
    Fault(
        45, "automatic-recovery", DEATHS, "auto",
        "drives again after <= 3 s, stale executed <= 0, latches passed over <= 0",
    ),
    Fault(
        46, "goal-goes-on", ERRAND, "",
        "travel <= 0.15 m, moved without it <= 0.005 m, goes on after <= 5 s, given up <= 0, "
        "off its goal <= 0.2 m", ("nav",),
    ),
    Fault(
        47, "map-goes-on", ERRAND, "",
        "mapping lost <= 10 s, found after <= 5 s, drives again after <= 10 s", ("nav",),
    ),
    Fault(
        48, "frozen-for-ever", FROZEN, "", "drives again after <= 12 s wall, stale executed <= 0",
    ),
    Fault(
        49, "one-message", EXTREMES, "",
        "silent <= 0, memory grown <= 50 MB, drives again after <= 3 s wall, "
        "after a death <= 10 s wall",
        ("nav",),
        loads=True,
    ),
)  # fmt: skip


def choose(wanted: Iterable[str]) -> tuple[Fault, ...]:
    """Those named, by number or name, in the table's order; all without names.

    Raises UnknownName.
    """
    names = {fault.name: fault for fault in FAULTS}
    numbers = {str(fault.number): fault for fault in FAULTS}
    chosen = set()
    for text in wanted:
        found = numbers.get(text) or names.get(text)
        if not found:
            raise unknown(f"fault (a name, or a number from 1 to {len(FAULTS)})", text, names)
        chosen.add(found.number)
    return tuple(fault for fault in FAULTS if not chosen or fault.number in chosen)
