"""A robot's description as a MuJoCo model, and how its links touch the floor."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from famle_envs.engines.world import FIELD_OF_VIEW, MARKER_COLOUR, PICTURE_SIZE, Array, Body, Marker

__all__ = ["LINK_FRICTION", "SEEN", "Contacts", "compile_model"]

LINK_FRICTION = 0.5  # PyBullet's, of a link whose description has none
_LINK_DAMPING = 0.1  # the same, of contacts (N s/m)
SEEN = 1  # the group of the shapes in a picture; those that collide are in group 0
_FLOOR_COLOURS, _SKY_COLOUR = ((0.93, 0.93, 0.93), (0.63, 0.72, 0.93)), (1.0, 1.0, 1.0)


def compile_model(description: ElementTree.Element, folder: Path, body: Body, marker: Marker | None) -> Any:
    """Compiles a robot and what stands around it.

    Args:
        description: The root of the robot's URDF.
        folder: That of the URDF, to which the names of meshes are relative.
        body: What the URDF does not say.
        marker: What one sees beside the robot.

    Returns:
        The ``mujoco.MjModel``.
    """
    extension = ElementTree.SubElement(description, "mujoco")
    kept = {"discardvisual": "false", "fusestatic": "false", "strippath": "false", "meshdir": str(folder)}
    ElementTree.SubElement(extension, "compiler", kept)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(description, encoding="unicode"))
    world, seen = spec.worldbody, {"group": SEEN, "contype": 0, "conaffinity": 0}
    base = world.first_body()
    if not body.fixed:
        base.add_freejoint()
        base.pos = (0.0, 0.0, body.height)
    # Links touch the floor, but not each other.
    for geom in spec.geoms:
        geom.contype, geom.conaffinity, geom.priority = int(geom.group != SEEN), 0, 1
    if not body.fixed:
        floor = {**seen, "conaffinity": 1, "material": "floor"}
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0.0, 0.0, 1.0), **floor)
    for ends in body.loops:
        sites = [spec.body(link).add_site(name=f"{link} end", pos=point).name for link, point in ends]
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE, name1=sites[0], name2=sites[1]
        )
    if marker is not None:
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER if marker.height else mujoco.mjtGeom.mjGEOM_SPHERE
        size = (marker.radius, 0.5 * marker.height, 0.0)
        world.add_geom(type=kind, size=size, pos=marker.position, rgba=MARKER_COLOUR, **seen)
    _light(spec)
    return spec.compile()


def _light(spec: Any) -> None:
    """Gives a model its floor's material, its sky and its light."""
    one, other = _FLOOR_COLOURS
    texture, builtin = mujoco.mjtTexture, mujoco.mjtBuiltin
    size = {"width": 64, "height": 64}
    spec.add_texture(
        name="tiles", type=texture.mjTEXTURE_2D, builtin=builtin.mjBUILTIN_CHECKER, rgb1=one, rgb2=other, **size
    )
    sky = {"rgb1": _SKY_COLOUR, "rgb2": _SKY_COLOUR, **size}
    spec.add_texture(name="sky", type=texture.mjTEXTURE_SKYBOX, builtin=builtin.mjBUILTIN_FLAT, **sky)
    floor = spec.add_material(name="floor", texrepeat=(0.5, 0.5), texuniform=True, specular=0.0)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    light, whole = spec.visual.headlight, spec.visual.global_
    light.ambient, light.diffuse, light.specular = (0.5,) * 3, (0.5,) * 3, (0.0,) * 3
    whole.fovy, whole.offwidth, whole.offheight = FIELD_OF_VIEW, PICTURE_SIZE, PICTURE_SIZE


class Contacts:
    """How the links of a robot touch the floor; all of it is kept in their shapes, which outrank the floor's."""

    def __init__(self, description: ElementTree.Element, model: Any) -> None:
        self._geoms = np.flatnonzero(model.geom_contype)
        self._links = model.geom_bodyid[self._geoms]
        names = [model.body(link).name for link in self._links]
        said = {link.get("name"): link for link in description.iter("link")}

        def values(name: str, default: float) -> Array:
            elements = [said[link].find(f"contact/{name}") for link in names]
            return np.array([default if element is None else float(element.attrib["value"]) for element in elements])

        self._friction = values("lateral_friction", LINK_FRICTION)
        self._stiffness, self._damping = values("stiffness", math.inf), values("damping", _LINK_DAMPING)
        self._rigid = model.geom_solref[self._geoms].copy(), model.geom_solimp[self._geoms].copy()

    def apply(self, model: Any, friction: float, stiffness: float, damping: float) -> None:
        """Combines the floor's with each link's: frictions multiply, springs are in series, dampings add up."""
        model.geom_friction[self._geoms, 0] = friction * self._friction
        model.geom_solref[self._geoms], model.geom_solimp[self._geoms] = self._rigid
        compliance = 1.0 / self._stiffness + (1.0 / stiffness if stiffness else 0.0)
        soft, dt = compliance > 0.0, model.opt.timestep
        spring = 1.0 / compliance[soft]
        damper = self._damping[soft] + (damping if stiffness else _LINK_DAMPING)
        # A spring and a damper at the end of a step are f = -(k dt + c) (v + a dt) - k r = (a_ref - a) / give,
        give = 1.0 / (dt * (spring * dt + damper))
        # which MuJoCo has where the rigidity is the part of the give that is the link's own.
        own = model.body_invweight0[self._links[soft], 0]
        rigidity = np.clip(own / (own + give), 1e-4, 0.9999)
        model.geom_solref[self._geoms[soft], 0] = -rigidity * spring * give
        model.geom_solref[self._geoms[soft], 1] = -rigidity / dt
        model.geom_solimp[self._geoms[soft], :2] = rigidity[:, None]
