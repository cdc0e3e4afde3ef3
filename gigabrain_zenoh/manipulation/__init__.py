"""Arms: reaching, planning round obstacles, trajectories and grasps. A library: it knows no bus.

It may import config, geometry, kernels and the errors. It needs the extra `arm`: MuJoCo, Ruckig
and numba, by which inverse kinematics takes a twentieth of the time that numpy takes.
Decision, control, safety, ui and qa may import it.

An arm is known by its description (joints with limits) and its MJCF model alone; all poses are in
the frame of the model's body `base`. Of the model it needs: that body, the joints, the tool's site
(x is the approach, z the direction in which fingers close), and for grasps two geoms, `pad_fixed`
and `pad_moving`, at the fingers' tips. Those may have a prefix, as in `arm_pad_fixed`.
"""
