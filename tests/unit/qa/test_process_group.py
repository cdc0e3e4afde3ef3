"""Processes of a measurement: the error of the one that ended it."""

import pytest

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.robot_under_test import ProcessGroup
from gigabrain_zenoh.runtime.supervisor import ProcessSpec


@pytest.mark.long
async def test_a_measurement_ends_with_the_error_of_the_process_that_ended_it() -> None:
    group = ProcessGroup([ProcessSpec("driver", ()), ProcessSpec("camera", (), optional=True)])
    for status in group.supervisor.statuses.values():
        status.state, status.last_exit = "given up", 2
        text = f"{status.name} lacks something"
        group._record(status.name, {"process": status.name, "event": "failed", "text": text})
    with pytest.raises(ConfigError, match=r"^driver lacks something$"):
        group.check_processes()
