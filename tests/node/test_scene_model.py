"""A scene that was sent is drawn as it is in the simulation."""

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


def live(body: str, world: str = "warehouse") -> tuple[Simulation, LiveWorld]:
    robot, driver = make_driver(body, Run(folder=Path(), world=world, seed=1))
    one = Simulation(sim_body(robot, driver.options, driver.run), load_world(world, 1), 1)
    return one, LiveWorld(one, world)


def sent(world: LiveWorld) -> tuple[SimScene, SimPoses]:
    """The messages as they are on the wire."""
    (_, scene), (_, poses) = world.scene()
    wire = [msgspec.msgpack.encode(message) for message in (scene, poses)]
    return (
        msgspec.msgpack.decode(wire[0], type=SimScene),
        msgspec.msgpack.decode(wire[1], type=SimPoses),
    )


def middles(model: mujoco.MjModel, data: mujoco.MjData, geoms: list[int]) -> NDArray[np.float64]:
    """Places of shapes; of meshes the middle of their vertices, as their frames may differ."""
    found = data.geom_xpos[geoms].copy()
    for row, geom in enumerate(geoms):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            middle = model.mesh_vert[first : first + count].mean(axis=0)
            found[row] += data.geom_xmat[geom].reshape(3, 3) @ middle
    return found


@pytest.mark.parametrize("body", ["turtlebot3_waffle", "alpha"])
def test_every_shape_is_where_the_simulation_has_it(body: str) -> None:
    one, world = live(body)
    for _ in range(100):
        one.drive(0.2, 0.0, 0.5)
        one.advance()
    mujoco.mj_kinematics(one.model, one.data)
    scene, poses = sent(world)
    made = SceneModel(scene)
    assert made.place(poses)
    drawn = [
        geom
        for geom in range(one.model.ngeom)
        if one.model.geom_group[geom] < 3
        and (one.model.geom_matid[geom] >= 0 or one.model.geom_rgba[geom][3] > 0)
        and not one.model.body(one.model.geom_bodyid[geom]).name.startswith("spare/")
    ]
    ours = middles(one.model, one.data, drawn)
    theirs = middles(made.model, made.data, list(range(made.model.ngeom)))
    assert len(ours) == len(theirs)
    apart = np.linalg.norm(ours[:, None] - theirs[None], axis=2)
    assert apart.min(axis=0).max() < 2e-3
    assert apart.min(axis=1).max() < 2e-3
    assert made.robot_place() == pytest.approx(one.truth.pose()[:2], abs=1e-3)


def test_things_are_drawn_beside_the_model_with_their_size_and_place() -> None:
    one, world = live("turtlebot3_waffle", "arena")
    made = SceneModel(sent(world)[0])
    one.things.add(Thing(x=2.5, y=2.5, size=(0.4, 0.2, 0.6), name="crate"))
    one.things.add(Thing(kind="person", x=-2.5, y=-2.5))
    scene, poses = sent(world)
    assert made.update(scene)
    assert made.place(poses)
    renderer = mujoco.MjvScene(made.model, 100)
    made.add_things(renderer)
    assert renderer.ngeom == 4
    sizes = [renderer.geoms[i].size.round(3).tolist() for i in range(4)]
    places = [renderer.geoms[i].pos.round(3).tolist() for i in range(4)]
    assert [0.2, 0.1, 0.3] in [pytest.approx(size) for size in sizes]
    assert [0.25, 0.25, 0.6] in [pytest.approx(size) for size in sizes]
    assert [2.5, 2.5, 0.3] in [pytest.approx(place) for place in places]
    one.things.remove("crate")
    assert made.update(sent(world)[0])


def test_another_world_is_no_update_and_its_poses_are_not_taken() -> None:
    made = SceneModel(sent(live("turtlebot3_waffle", "arena")[1])[0])
    scene, poses = sent(live("turtlebot3_waffle", "house")[1])
    assert not made.place(msgspec.structs.replace(poses, version=7))
    assert not made.update(scene)


def test_a_scene_whose_numbers_name_nothing_is_refused() -> None:
    scene = EXAMPLES["SimScene"]
    assert isinstance(scene, SimScene)
    assert [shape.kind for shape in shapes_of(scene)] == ["plane", "mesh", "box"]
    for changes in ({"kinds": b"\0\0\x63"}, {"owners": b"\0\0\0\0\xff\xff"}):
        with pytest.raises(ConfigError, match="unknown kind, or on an unknown body"):
            SceneModel(msgspec.structs.replace(scene, **changes))


@pytest.mark.parametrize("number", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("field", ["sizes", "places"])
def test_a_shape_of_no_finite_size_or_place_is_refused(field: str, number: float) -> None:
    scene = EXAMPLES["SimScene"]
    values = np.frombuffer(getattr(scene, field), "<f4").copy()
    for at in range(0, len(values), 3):  # of each kind of shape
        changed = values.copy()
        changed[at] = number
        with pytest.raises(ConfigError, match="size or a place that is not finite"):
            SceneModel(msgspec.structs.replace(scene, **{field: changed.tobytes()}))


@pytest.mark.parametrize("corner", [3, 2**31, 2**32 - 1])
def test_a_mesh_whose_faces_name_no_vertex_is_refused(corner: int) -> None:
    scene = EXAMPLES["SimScene"]
    assert isinstance(scene, SimScene)
    faces = np.frombuffer(scene.meshes[0].faces, "<u4").copy()
    faces[0] = corner
    wrong = msgspec.structs.replace(scene.meshes[0], faces=faces.tobytes())
    with pytest.raises(ConfigError, match="mesh 0 has faces at vertices that it has not"):
        SceneModel(msgspec.structs.replace(scene, meshes=(wrong,)))


def test_poses_that_are_not_finite_are_not_taken() -> None:
    scene, poses = sent(live("turtlebot3_waffle", "arena")[1])
    made = SceneModel(scene)
    values = np.frombuffer(poses.poses, "<f4").copy()
    values[3] = np.nan
    assert made.place(poses)
    assert not made.place(msgspec.structs.replace(poses, poses=values.tobytes()))


def test_a_scene_of_more_meshes_than_a_message_may_carry_shows_the_rest_as_boxes() -> None:
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
    scene, poses = sent(live("turtlebot3_waffle", "arena")[1])
    made = SceneModel(scene)
    made.place(poses)
    try:
        made.save(tmp_path / "now.png")
    except ConfigError as error:
        pytest.skip(str(error))
    assert (tmp_path / "now.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "now.png").stat().st_size > 20_000
