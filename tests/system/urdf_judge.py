"""Reads a URDF by Pinocchio, for `test_arm_judges.py`: `python urdf_judge.py FILE`.

Its parser of URDFs is urdfdom, as RViz's is. FILE is JSON: `urdf`, `postures` with the position of
each joint by name, and the `frames` to tell of. Prints, as JSON, the poses (4, 4) of those frames
at each posture, the mass, centre and inertia of all together at the last one, and the limits of
each joint.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pinocchio

given = json.loads(Path(sys.argv[1]).read_text())
root = pinocchio.JointModelFreeFlyer()  # so that what does not move has a mass as well
model = pinocchio.buildModelFromXML(given["urdf"], root)
data, body = model.createData(), pinocchio.FrameType.BODY  # joints may have the same names
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
