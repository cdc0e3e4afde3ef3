"""Arms: reaching, planning round obstacles, trajectories and grasps. A library: it knows no bus.

It may import config, geometry, kernels and the errors. It needs the extra `arm`: MuJoCo, Ruckig
and numba, with which inverse kinematics is twenty times as fast as with numpy.
Decision, control, safety, ui and qa may import it.

The description (joints with limits) and the MJCF model define an arm. All poses are in the frame of
the model's body `base`. The model must have that body, the joints, and the tool's site (x is the
approach, z the direction in which fingers close). Grasps also need two geoms at the fingers' tips,
`pad_fixed` and `pad_moving`. Their names may have a prefix, as in `arm_pad_fixed`.
"""
