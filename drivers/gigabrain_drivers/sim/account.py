"""What a simulated run came to."""

from typing import Any

from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.sim.physics import Simulation


def account_of(simulation: Simulation, robot: RobotFile, run: Run) -> dict[str, Any]:
    """The truth of the run so far, by the physics itself."""
    truth = simulation.truth
    pose = truth.pose()
    return {
        "body": robot.robot_type,
        "world": run.world,
        "seed": run.seed,
        "sim_seconds": round(simulation.time_ns / 1e9, 2),
        "distance_m": round(truth.distance_m, 3),
        "contacts": truth.contacts,
        "min_clearance_m": round(truth.min_clearance_m, 3),
        "person_stood": simulation.person_stood,
        "true_speed": round(truth.speed()[0], 4),
        "true_x": round(pose.x, 4),
        "true_y": round(pose.y, 4),
        "true_yaw": round(pose.yaw, 4),
    }
