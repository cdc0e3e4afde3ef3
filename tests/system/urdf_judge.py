"""Read a URDF by Pinocchio, for `test_arm_judges.py`: `python urdf_judge.py FILE`.

Pinocchio parses with urdfdom, as RViz does. FILE is JSON: `urdf`, `postures` with the position of
each joint by name, and names of `frames`. Prints JSON: the poses (4, 4) of those frames at each
posture, mass, centre and inertia of the whole at the last posture, and the limits of each joint.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pinocchio

given = json.loads(Path(sys.argv[1]).read_text())
root = pinocchio.JointModelFreeFlyer()  # else fixed parts have no mass
model = pinocchio.buildModelFromXML(given["urdf"], root)
data, body = model.createData(), pinocchio.FrameType.BODY  # joints may have equal names
frames, places = [model.getFrameId(name, body) for name in given["frames"]], []
for posture in given["postures"]:
    q = pinocchio.neutral(model)
    for name, position in posture.items():
        q[model.idx_qs[model.getJointId(name)]] = position
    pinocchio.framesForwardKinematics(model, data, q)
    places.append([data.oMf[frame].homogeneous.tolist() for frame in frames])
pinocchio.ccrba(model, data, q, np.zeros(model.nv))
limits = {
    name: [float(ends[index]) for ends in (model.lowerPositionLimit, model.upperPositionLimit)]
    for name, index in zip(model.names, model.idx_qs, strict=True)
}
print(json.dumps({
    "places": places, "limits": limits, "mass": data.Ig.mass,
    "centre": pinocchio.centerOfMass(model, data, q).tolist(), "tensor": data.Ig.inertia.tolist(),
}))  # fmt: skip
