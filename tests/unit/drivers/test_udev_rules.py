"""The udev rules are well-formed, and know the devices that the robots' files name."""

import re
from pathlib import Path

import pytest

from gigabrain_drivers.driver.catalog import load_robot, robot_files

RULES = Path(__file__).parents[3] / "deploy" / "70-gigabrain.rules"
MATCHES = {"ACTION", "SUBSYSTEM", "DRIVER", "ATTR", "ATTRS", "KERNEL", "ENV"}
ASSIGNS = {"MODE", "GROUP", "SYMLINK", "ENV", "ATTR", "GOTO", "LABEL", "TAG"}
PART = re.compile(r'([A-Z]+)(?:\{([A-Za-z_]+)\})?(==|!=|\+=|:=|=)"([^"]*)"')


def rules() -> list[str]:
    lines = RULES.read_text(encoding="ascii").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


@pytest.mark.parametrize("rule", rules())
def test_every_part_of_a_rule_is_a_match_or_an_assignment_that_udev_knows(rule: str) -> None:
    for part in rule.split(", "):
        found = PART.fullmatch(part)
        assert found, part
        key, _, operator, _ = found.groups()
        assert key in (MATCHES if operator in ("==", "!=") else ASSIGNS), part
        if key in ("MODE", "GROUP"):
            assert operator == "=", part


def test_every_goto_has_its_label_further_down() -> None:
    text = "\n".join(rules())
    for target in re.findall(r'GOTO="(\w+)"', text):
        assert text.index(f'LABEL="{target}"') > text.index(f'GOTO="{target}"')


def test_every_usb_device_of_our_robots_has_a_rule() -> None:
    files = [path.read_text() for path in robot_files().values() if load_robot(path.parent.name)]
    named = {match for text in files for match in re.findall(r"usb:(\w{4}:\w{4})", text)}
    text = RULES.read_text()
    known = set(re.findall(r'ATTRS\{idVendor\}=="(\w+)", ATTRS\{idProduct\}=="(\w+)"', text))
    assert {"0483:5740", "10c4:ea60"} <= named
    assert named <= {f"{vendor}:{product}" for vendor, product in known}
