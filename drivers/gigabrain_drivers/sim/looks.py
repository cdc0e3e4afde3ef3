"""What a world looks like: colours, sky, light and floor. Nothing here is felt by a robot."""

import mujoco

from gigabrain_drivers.sim.world import World

FLOOR = "floor"  # name of the floor's geom, material and texture

MATERIALS = {
    "wall": (0.93, 0.92, 0.89),
    "wood": (0.66, 0.47, 0.28),
    "dark_wood": (0.36, 0.24, 0.16),
    "carton": (0.76, 0.60, 0.42),
    "white": (0.95, 0.95, 0.95),
    "black": (0.06, 0.06, 0.07),
    "steel": (0.66, 0.69, 0.72),
    "blue": (0.20, 0.36, 0.60),
    "teal": (0.13, 0.52, 0.53),
    "green": (0.38, 0.56, 0.36),
    "leaf": (0.20, 0.46, 0.20),
    "clay": (0.72, 0.38, 0.26),
    "orange": (0.90, 0.48, 0.16),
    "yellow": (0.94, 0.76, 0.26),
    "skin": (0.86, 0.66, 0.53),
}


def add_materials(spec: mujoco.MjSpec, world: World) -> None:
    """Sky, the floor's checks, and a material for each colour that a shape may name."""
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.80, 0.87, 0.94),
        rgb2=(0.42, 0.52, 0.64),
        width=64,
        height=384,
    )
    spec.add_texture(
        name=FLOOR,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=world.floor[0],
        rgb2=world.floor[1],
        width=128,
        height=128,
    )
    repeat = (0.5 / world.check[0], 0.5 / world.check[1])  # a texture holds two checks each way
    floor = spec.add_material(name=FLOOR, texrepeat=repeat, texuniform=True, reflectance=0.04)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = FLOOR
    for name, colour in MATERIALS.items():
        spec.add_material(name=name, rgba=(*colour, 1), specular=0.2, shininess=0.3)


def add_light(spec: mujoco.MjSpec) -> None:
    """A low sun that casts shadows, and soft light from the camera."""
    spec.visual.headlight.ambient = (0.45, 0.45, 0.46)
    spec.visual.headlight.diffuse = (0.30, 0.30, 0.30)
    spec.visual.headlight.specular = (0.1, 0.1, 0.1)
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(0, 0, 5),
        dir=(0.30, 0.38, -0.87),
        diffuse=(0.62, 0.60, 0.56),
        specular=(0.25, 0.25, 0.25),
        castshadow=True,
    )
