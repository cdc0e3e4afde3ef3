"""`gigabrain audit NAME`: the log of a robot that does not run."""

from pathlib import Path

import pytest

from gigabrain_schemas.logs import AuditRecord
from gigabrain_zenoh.cli.gate import audit
from gigabrain_zenoh.errors import UnknownName
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.runtime.audit import AuditFile


@pytest.mark.parametrize("name", ["red", "site/red", "site/audit", "audit/audit"])
def test_the_log_of_a_robot_is_found_by_its_namespace(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    record = AuditRecord(process="driver", what="estop", source="ann", text="pressed")
    assert AuditFile(state_dir() / "robots" / name, "driver").append([record]) == ""
    audit(name)
    assert "pressed" in capsys.readouterr().out
    with pytest.raises(UnknownName, match=rf"known: {name}$"):
        audit("nobody")
