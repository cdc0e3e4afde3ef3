"""Nets as users export them: by their own packages, in a separate environment.

The first test installs some 1.5 GB, so they run in `make qa` only. They are skipped with a reason
if the packages or a torch without CUDA are not available.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.places import ROOT

pytestmark = pytest.mark.qa
RUNTIME = ("numpy", "onnx", "onnxruntime", "opencv-python-headless", "msgspec", "pyyaml", "pillow")
PACKAGES = {  # with their imports; big ones without dependencies, as those include CUDA
    "ultralytics": "ultralytics ultralytics-thop torchvision requests psutil polars matplotlib "
    "scipy",
    "transformers": "transformers torchvision scipy",
    "rfdetr": "rfdetr torchvision supervision transformers pydantic pyDeprecate<0.10 tqdm requests "
    "defusedxml scipy",
}
BIG = ("ultralytics", "ultralytics-thop", "torchvision", "rfdetr", "supervision")


def pip(python: Path, *words: str) -> str:
    """Run pip; skip the test with pip's last error if something is not available."""
    made = subprocess.run(
        (python, "-m", "pip", *words), capture_output=True, text=True, check=False
    )
    if made.returncode:
        lines = [one for one in made.stderr.splitlines() if one.startswith("ERROR")]
        pytest.skip(f"pip {' '.join(words[:6])}: {lines[-1] if lines else made.stderr[-200:]}")
    return made.stdout


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the interpreter of an environment with a torch without CUDA."""
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run((sys.executable, "-m", "venv", folder), check=True)
    there = folder / "bin" / "python"
    versions = pip(there, "index", "versions", "torch")
    plain = re.search(r"[\d.]+\+cpu", versions)
    if not plain:
        pytest.skip("the package index has no torch without CUDA")
    pip(there, "install", f"torch=={plain[0]}", *RUNTIME)
    return there


@pytest.mark.parametrize(
    ("net", "package"),
    [
        ("yolov8n", "ultralytics"),
        ("yolo11n", "ultralytics"),
        ("yolo11n-dynamic", "ultralytics"),
        ("detr", "transformers"),
        ("rf_detr", "rfdetr"),
    ],
)
def test_our_boxes_agree_with_those_of_the_exporting_package(
    net: str, package: str, python: Path, tmp_path: Path
) -> None:
    wanted = PACKAGES[package].split()
    pip(python, "install", "--no-deps", *(one for one in wanted if one in BIG))
    pip(python, "install", *(one for one in wanted if one not in BIG))
    path = os.pathsep.join(str(ROOT / one) for one in (".", "schemas", "drivers"))
    offline = {"YOLO_OFFLINE": "1", "YOLO_CONFIG_DIR": str(tmp_path), "YOLO_AUTOINSTALL": "false",
               "HF_HUB_OFFLINE": "1"}  # fmt: skip
    script = Path(__file__).with_name("exported_nets.py")
    made = subprocess.run(
        (python, script, net, tmp_path), capture_output=True, text=True, check=False,
        env=os.environ | offline | {"PYTHONPATH": path},
    )  # fmt: skip
    assert made.returncode == 0, made.stderr[-2000:]
    compared = json.loads(made.stdout.splitlines()[-1])
    assert compared["found"] >= 10
    assert compared["judged"] >= compared["found"] * 0.7
    assert compared["missed"] == 0
    assert compared["off_px"] < 0.1
    assert compared["off_score"] < 1e-4
