"""`--link emulated`: the real driver beside the emulator, with an unchanged brain."""

import json
from pathlib import Path

import msgspec
import pytest

from gigabrain_zenoh.config.settings import ProcessConfig
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.testing.processes import AVOID, Home


def specs(tmp_path: Path, link: str) -> dict[str, tuple[tuple[str, ...], ProcessConfig]]:
    deployment = msgspec.convert({"body": "mycustombot", "link": link}, Deployment)
    found = process_specs(deployment, "robot", tmp_path, tmp_path / "state")
    return {
        spec.name: (spec.after, msgspec.json.decode(spec.config, type=ProcessConfig))
        for spec in found
    }


def test_the_emulator_starts_before_the_driver_with_the_same_folder(
    tmp_path: Path,
) -> None:
    found = specs(tmp_path, "emulated")
    assert list(found)[:3] == ["router", "emulator", "driver"]
    assert found["driver"][0] == ("router", "emulator")
    assert found["emulator"][0] == ("router",)
    ports = str(tmp_path / "ports")
    assert found["emulator"][1].settings["folder"] == ports
    assert found["driver"][1].settings["emulator"] == ports


@pytest.mark.parametrize("link", ["sim", "real"])
def test_other_links_have_no_emulator(tmp_path: Path, link: str) -> None:
    found = specs(tmp_path, link)
    assert "emulator" not in found
    assert found["driver"][0] == ("router",)


@pytest.mark.slow
async def test_a_robot_roams_over_two_emulated_serial_lines(home: Home) -> None:
    path = home.folder / "report.json"
    for seconds in ("8", "30", "60"):  # repeat longer: a busy machine may stop it
        demo = await home.run(
            *AVOID, "--body", "mycustombot", "--link", "emulated", "--seconds", seconds,
            "--headless", "--report", str(path),
        )  # fmt: skip
        report = json.loads(path.read_bytes())
        if report["distance_m"] > 0.3:
            break
    assert await demo.ended() == 0, demo.err
    assert (report["body"], report["contacts"], report["restarts"]) == ("mycustombot", 0, 0)
    assert report["distance_m"] > 0.3
    assert report["min_clearance_m"] > 0.05


async def test_a_real_body_is_not_enabled_at_the_start(home: Home) -> None:
    demo = await home.run(
        *AVOID, "--body", "mycustombot", "--link", "real", "--seconds", "1.5", "--headless"
    )
    await demo.ended()
    assert "enabled" not in "".join(p.read_text() for p in home.folder.rglob("driver.jsonl"))
    refused = await home.run(
        *AVOID, "--body", "mycustombot", "--link", "real", "--resume", "auto", "--headless"
    )
    assert await refused.ended() == 2
    assert "resume: auto is not allowed" in refused.err
