"""Solve inverse kinematics by mink, for `test_arm_judges.py`: `python arm_judges.py MODEL GOALS`.

GOALS is JSON: for each goal a start posture (5,), a position (3,) and a quaternion (4,). Prints a
JSON list: for each goal, true if mink comes within 0.1 mm and 0.01 rad of it.
"""

import json
import sys
from pathlib import Path

import mink
import mujoco
import numpy as np

model = mujoco.MjModel.from_xml_path(sys.argv[1])
task = mink.FrameTask("tool", "site", position_cost=1.0, orientation_cost=0.1, lm_damping=1e-6)
limits = [mink.ConfigurationLimit(model)]
found = []
for start, place, turn in json.loads(Path(sys.argv[2]).read_text()):
    configuration = mink.Configuration(model, np.array([*start, 0.0]))
    task.set_target(
        mink.SE3.from_rotation_and_translation(mink.SO3(np.array(turn)), np.array(place))
    )
    for _ in range(200):
        speed = mink.solve_ik(configuration, [task], 0.1, "daqp", 1e-8, limits=limits)
        configuration.integrate_inplace(speed, 0.1)
        error = task.compute_error(configuration)
        if np.linalg.norm(error[:3]) < 1e-4 and np.linalg.norm(error[3:]) < 0.01:
            break
    error = task.compute_error(configuration)
    near = np.linalg.norm(error[:3]) < 1e-4 and np.linalg.norm(error[3:]) < 0.01
    found.append(bool(near))
print(json.dumps(found))
