"""A scene from the bus is drawn as it is in the simulation."""

from pathlib import Path

import msgspec
import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import sim_body
from gigabrain_drivers.sim.live_world import LiveWorld
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.scene_message import SceneWriter
from gigabrain_drivers.sim.scene_model import SceneModel, shapes_of
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sim import SimPoses, SimScene, Thing
from gigabrain_zenoh.errors import ConfigError


def make_world(body: str, world: str = "warehouse") -> tuple[Simulation, LiveWorld]:
    robot, driver = make_driver(body, Run(folder=Path(), world=world, seed=1))
    simulation = Simulation(sim_body(robot, driver.options, driver.run), load_world(world, 1), 1)
    return simulation, LiveWorld(simulation, world)


def received_scene(world: LiveWorld) -> tuple[SimScene, SimPoses]:
    """Return scene and poses after encoding and decoding."""
    (_, scene), (_, poses) = world.scene()
    wire = [msgspec.msgpack.encode(message) for message in (scene, poses)]
    return (
        msgspec.msgpack.decode(wire[0], type=SimScene),
        msgspec.msgpack.decode(wire[1], type=SimPoses),
    )


def middles(model: mujoco.MjModel, data: mujoco.MjData, geoms: list[int]) -> NDArray[np.float64]:
    """Return the middles of shapes; for meshes that of their vertices, as frames may differ."""
    found = data.geom_xpos[geoms].copy()
    for row, geom in enumerate(geoms):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            middle = model.mesh_vert[first : first + count].mean(axis=0)
            found[row] += data.geom_xmat[geom].reshape(3, 3) @ middle
    return found


@pytest.mark.parametrize("body", ["turtlebot3_waffle", "alpha"])
def test_every_shape_is_at_its_place_in_the_simulation(body: str) -> None:
    simulation, world = make_world(body)
    for _ in range(100):
        simulation.drive(0.2, 0.0, 0.5)
        simulation.advance()
    mujoco.mj_kinematics(simulation.model, simulation.data)
    scene, poses = received_scene(world)
    scene_model = SceneModel(scene)
    assert scene_model.place(poses)
    drawn = [
        geom
        for geom in range(simulation.model.ngeom)
        if simulation.model.geom_group[geom] < 3
        and (simulation.model.geom_matid[geom] >= 0 or simulation.model.geom_rgba[geom][3] > 0)
        and not simulation.model.body(simulation.model.geom_bodyid[geom]).name.startswith("spare/")
    ]
    ours = middles(simulation.model, simulation.data, drawn)
    theirs = middles(scene_model.model, scene_model.data, list(range(scene_model.model.ngeom)))
    assert len(ours) == len(theirs)
    apart = np.linalg.norm(ours[:, None] - theirs[None], axis=2)
    assert apart.min(axis=0).max() < 2e-3
    assert apart.min(axis=1).max() < 2e-3
    assert scene_model.robot_place() == pytest.approx(simulation.truth.pose()[:2], abs=1e-3)


def test_added_things_are_drawn_with_their_size_and_place() -> None:
    simulation, world = make_world("turtlebot3_waffle", "arena")
    scene_model = SceneModel(received_scene(world)[0])
    simulation.things.add(Thing(x=2.5, y=2.5, size=(0.4, 0.2, 0.6), name="crate"))
    simulation.things.add(Thing(kind="person", x=-2.5, y=-2.5))
    scene, poses = received_scene(world)
    assert scene_model.update(scene)
    assert scene_model.place(poses)
    renderer = mujoco.MjvScene(scene_model.model, 100)
    scene_model.add_things(renderer)
    assert renderer.ngeom == 4
    sizes = [renderer.geoms[i].size.round(3).tolist() for i in range(4)]
    places = [renderer.geoms[i].pos.round(3).tolist() for i in range(4)]
    assert [0.2, 0.1, 0.3] in [pytest.approx(size) for size in sizes]
    assert [0.25, 0.25, 0.6] in [pytest.approx(size) for size in sizes]
    assert [2.5, 2.5, 0.3] in [pytest.approx(place) for place in places]
    simulation.things.remove("crate")
    assert scene_model.update(received_scene(world)[0])


def test_scene_and_poses_of_another_world_are_rejected() -> None:
    scene_model = SceneModel(received_scene(make_world("turtlebot3_waffle", "arena")[1])[0])
    scene, poses = received_scene(make_world("turtlebot3_waffle", "house")[1])
    assert not scene_model.place(msgspec.structs.replace(poses, version=7))
    assert not scene_model.update(scene)


def test_a_scene_with_unknown_kinds_or_bodies_is_refused() -> None:
    scene = EXAMPLES["SimScene"]
    assert isinstance(scene, SimScene)
    assert [shape.kind for shape in shapes_of(scene)] == ["plane", "mesh", "box"]
    for changes in ({"kinds": b"\0\0\x63"}, {"owners": b"\0\0\0\0\xff\xff"}):
        with pytest.raises(ConfigError, match="unknown kind, or on an unknown body"):
            SceneModel(msgspec.structs.replace(scene, **changes))


@pytest.mark.parametrize("number", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("field", ["sizes", "places"])
def test_a_shape_without_finite_size_and_place_is_refused(field: str, number: float) -> None:
    scene = EXAMPLES["SimScene"]
    values = np.frombuffer(getattr(scene, field), "<f4").copy()
    for at in range(0, len(values), 3):  # one value of each shape
        changed = values.copy()
        changed[at] = number
        with pytest.raises(ConfigError, match="size or a place that is not finite"):
            SceneModel(msgspec.structs.replace(scene, **{field: changed.tobytes()}))


@pytest.mark.parametrize("corner", [3, 2**31, 2**32 - 1])
def test_a_mesh_with_faces_at_unknown_vertices_is_refused(corner: int) -> None:
    scene = EXAMPLES["SimScene"]
    assert isinstance(scene, SimScene)
    faces = np.frombuffer(scene.meshes[0].faces, "<u4").copy()
    faces[0] = corner
    wrong = msgspec.structs.replace(scene.meshes[0], faces=faces.tobytes())
    with pytest.raises(ConfigError, match="mesh 0 has faces at vertices that it has not"):
        SceneModel(msgspec.structs.replace(scene, meshes=(wrong,)))


def test_poses_that_are_not_finite_are_rejected() -> None:
    scene, poses = received_scene(make_world("turtlebot3_waffle", "arena")[1])
    scene_model = SceneModel(scene)
    values = np.frombuffer(poses.poses, "<f4").copy()
    values[3] = np.nan
    assert scene_model.place(poses)
    assert not scene_model.place(msgspec.structs.replace(poses, poses=values.tobytes()))


def test_meshes_beyond_the_limit_of_a_message_are_shown_as_boxes() -> None:
    corners = "0 0 0 1 0 0 0 1 0 0 0 1"
    meshes = [f'<mesh name="m{n}" vertex="{corners}" scale=".1 .1 .1"/>' for n in range(1010)]
    geoms = [f'<geom type="mesh" mesh="m{n}" pos="{n} 0 0"/>' for n in range(1010)]
    text = (
        f"<mujoco><asset>{''.join(meshes)}</asset><worldbody>{''.join(geoms)}</worldbody></mujoco>"
    )
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = SceneWriter(model, data, "hall").scene(1, (), {})
    received = msgspec.msgpack.decode(msgspec.msgpack.encode(scene), type=SimScene)
    kinds = [shape.kind for shape in shapes_of(received)]
    assert (kinds.count("mesh"), kinds.count("box")) == (1000, 10)


def test_a_picture_of_a_running_world_is_saved(tmp_path: Path) -> None:
    scene, poses = received_scene(make_world("turtlebot3_waffle", "arena")[1])
    scene_model = SceneModel(scene)
    scene_model.place(poses)
    try:
        scene_model.save(tmp_path / "now.png")
    except ConfigError as error:
        pytest.skip(str(error))
    assert (tmp_path / "now.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "now.png").stat().st_size > 20_000
