"""A folder that this user may not enter; root, who runs some of the tests, may enter any."""

import os
from pathlib import Path
from typing import Any

import pytest


def close_folder(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Refuse to look into `folder`, until the end of the test."""
    stat, access = os.stat, os.access

    def refusing_stat(path: Any, *arguments: Any, **options: Any) -> os.stat_result:
        if not isinstance(path, int) and folder in Path(path).absolute().parents:
            raise PermissionError(13, "Permission denied", str(path))
        return stat(path, *arguments, **options)

    def refusing_access(path: Any, *arguments: Any) -> bool:
        there = Path(path).absolute()
        return there != folder and folder not in there.parents and access(path, *arguments)

    patch.setattr(os, "stat", refusing_stat)
    patch.setattr(os, "access", refusing_access)
