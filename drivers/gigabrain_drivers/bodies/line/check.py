"""Whether the lines fit the body: a command that moves all of it, a state that says how it moves.

Each check raises ValueError as `FIELD: what is wrong; what was expected`.
"""

from collections.abc import Iterable

from gigabrain_drivers.bodies.line.fields import ANGLES
from gigabrain_drivers.bodies.line.options import LineOptions
from gigabrain_drivers.bodies.line.protocol import Template
from gigabrain_drivers.driver.robot import RobotFile
from gigabrain_drivers.kinematics import Ackermann, Base, Twist, base_of, missing_measures

COARSEST = 0.1  # of the most that a body can do: the largest step in which it may be told
WHEEL_PARTS = ("_position", "_velocity", "_effort", "_temperature")
POSE = ("x", "y", "yaw")


def check(options: LineOptions, robot: RobotFile) -> None:
    """All that the options alone cannot tell."""
    base, command, state = base_of(robot), options.command_template(), options.state_templates()
    for field, template in {"command": command, **_numbered(state)}.items():
        _check_wheels(field, template, robot, base)
    _check_command(command, robot, base)
    _check_steps(command, robot, base)
    _check_odometry(state, base)
    _check_motion(state, robot, base)
    if robot.lidar and options.scan is None:
        raise ValueError(
            "scan: `lidar` says that the body has one; expected where its scans come from, such "
            "as {driver: ld19, port: usb:10c4:ea60}, or no `lidar`"
        )


def speeds_of(base: Base) -> tuple[str, ...]:
    """The state fields from which a base's velocity follows; a wheel that steers has an angle."""
    return tuple(f"wheel_{n}_{'position' if n in ANGLES else 'velocity'}" for n in base.wheels)


def positions_of(base: Base) -> tuple[str, ...]:
    """The state fields by which a base's way is reckoned."""
    return tuple(f"wheel_{name}_position" for name in base.wheels)


def _numbered(state: tuple[Template, ...]) -> dict[str, Template]:
    return {f"state[{i}]": template for i, template in enumerate(state)}


def _check_wheels(field: str, template: Template, robot: RobotFile, base: Base | None) -> None:
    known = {f"wheel_{n}{part}" for n in base.wheels for part in ("", *WHEEL_PARTS)} if base else ()
    for name in sorted(template.names):
        if not name.startswith("wheel_") or name in known:
            continue
        if lacking := missing_measures(robot):
            raise ValueError(
                f"{field}: {{{name}}} on a {robot.drive_type} base needs its "
                f"{' and '.join(lacking)} at the top of this file, above 0"
            )
        wheels = ", ".join(base.wheels) if base else "none"
        raise ValueError(f"{field}: no {name} on a {robot.drive_type} base; its wheels: {wheels}")


def _check_command(command: Template, robot: RobotFile, base: Base | None) -> None:
    body = _ways(robot)
    choices = [body]
    if base:
        choices.append([f"wheel_{name}" for name in base.wheels])
    if isinstance(base, Ackermann):
        choices.append(["linear_x", "wheel_steering"])
    names = command.names - {"seq"}
    if any(names == set(choice) for choice in choices) or names == {*body, "linear_y"}:
        return
    nearest = max(choices, key=lambda choice: len(names & set(choice)))
    if lacking := [name for name in nearest if name not in names]:
        wrong = f"no {_braced(lacking)}"
    else:
        wrong = f"{_braced(sorted(names - set(nearest)))} beside {_braced(nearest)}"
    needs = ", or ".join(_braced(choice) for choice in choices)
    raise ValueError(f"command: {wrong}; a {robot.drive_type} base needs {needs}")


def _check_steps(command: Template, robot: RobotFile, base: Base | None) -> None:
    most = {
        "linear_x": robot.max_linear_speed,
        "linear_y": robot.max_lateral_speed,
        "angular_z": robot.max_angular_speed,
    }
    if base:
        fastest = base.to_wheels(Twist(robot.max_linear_speed, 0.0, 0.0))
        most |= {f"wheel_{n}": abs(speed) for n, speed in zip(base.wheels, fastest, strict=True)}
    if isinstance(base, Ackermann):
        most["wheel_steering"] = base.max_steering
    for field in command.fields:
        top = most.get(field.name, 0.0)
        if top and field.step > COARSEST * top:
            raise ValueError(
                f"command: {{{field.name}}}: its smallest step is {field.step:.3g}, the most that "
                f"the body does {top:.3g} (in SI units); expected more decimals or a smaller unit"
            )


def _check_odometry(state: tuple[Template, ...], base: Base | None) -> None:
    """Where there is a pose or a wheel's position, all of it stands in one line."""
    for whole in (POSE, positions_of(base) if base else ()):
        telling = {
            n for n in whole if n.removeprefix("wheel_").removesuffix("_position") not in ANGLES
        }
        for i, template in enumerate(state):
            lacking = [name for name in whole if name not in template.names]
            if template.names & telling and lacking:
                raise ValueError(
                    f"state[{i}]: {_braced(whole)} must stand in one line, or none of them; "
                    f"in this one there is no {_braced(lacking)}"
                )


def _check_motion(state: tuple[Template, ...], robot: RobotFile, base: Base | None) -> None:
    """Every way in which the body can move is measured."""
    seen = frozenset[str]().union(*(template.names for template in state))
    wholes = [POSE, *((positions_of(base), speeds_of(base)) if base else ())]
    if any(seen.issuperset(whole) for whole in wholes):
        return
    ways = _ways(robot)
    lacking = [name for name in ways if name not in seen]
    if lacking:
        what = _braced(lacking) if len(lacking) < len(ways) else "how the body moves"
        choices = ", or ".join(_braced(whole) for whole in (ways, *wholes))
        raise ValueError(f"state: nothing in it says {what}; expected {choices}")


def _ways(robot: RobotFile) -> list[str]:
    """The parts of a velocity that the body can have."""
    return ["linear_x", *(["linear_y"] if robot.max_lateral_speed else []), "angular_z"]


def _braced(names: Iterable[str]) -> str:
    texts = [f"{{{name}}}" for name in names]
    return " and ".join(filter(None, (", ".join(texts[:-1]), texts[-1])))
