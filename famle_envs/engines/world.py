"""What a robot needs of a physics engine, and what it tells one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

__all__ = ["FAULTY_COLOUR", "HOLDING_TORQUE", "PICTURE_SIZE", "Array", "Body", "Camera", "Marker", "Steps", "World"]

Array: TypeAlias = npt.NDArray[np.floating[Any]]
Point: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]

HOLDING_TORQUE = 1e4  # of a locked joint, far above what any motor here can exert (N m)
DEFAULT_GAIN = 0.1
"""Part of the angle's error that a servo would make good in one physics step."""
GRAVITY = 9.81  # m/s^2
PICTURE_SIZE = 480  # pixels, to either side
FIELD_OF_VIEW = 60.0  # degrees
FAULTY_COLOUR = (0.85, 0.25, 0.2, 1.0)
MARKER_COLOUR = (0.15, 0.65, 0.3, 1.0)


@dataclass(frozen=True)
class Body:
    """A robot: its description, and what a URDF cannot say.

    Attributes:
        description: A URDF: masses, lengths, joints, and how the links touch the floor.
        joints: The motorised joints, in the order in which all arrays name them. All other joints turn freely.
        fixed: Whether the base is bolted down, where there is no floor. Else it starts at ``height`` above one, in m.
        start_angles: Of joints that do not start at zero, in rad.
        loops: Pairs of links that meet in a point, each (link, point in its frame) twice.
        package: Where the description is, with the meshes beside it; read when a robot is made.
    """

    description: str
    joints: tuple[str, ...]
    fixed: bool = False
    height: float = 0.0
    start_angles: Mapping[str, float] = field(default_factory=dict)
    loops: tuple[tuple[tuple[str, Point], tuple[str, Point]], ...] = ()
    package: str = "famle_envs.assets"

    @property
    def urdf(self) -> Traversable:
        """The description's file.

        Raises:
            ModuleNotFoundError: The package is not installed.
        """
        return files(self.package) / self.description


@dataclass(frozen=True)
class Steps:
    """How time passes: a call of the simulator lasts ``time_step`` s and is divided into ``substeps``.

    ``solver_iterations`` are PyBullet's; MuJoCo's solver goes on until it has converged.
    """

    time_step: float
    substeps: int
    solver_iterations: int


@dataclass(frozen=True)
class Marker:
    """A green ball that one only sees, or a disc where it has a height; all in m."""

    position: Point
    radius: float
    height: float = 0.0


@dataclass(frozen=True)
class Camera:
    """Looks at a target from a distance in m; yaw and pitch in degrees, yaw 0 looks along +y."""

    target: Point
    distance: float
    yaw: float
    pitch: float


class World(Protocol):
    """One robot in one private world. Arrays have an entry for each motorised joint.

    A motor tries to give its joint a speed with a torque within its bounds, in each physics step anew. A servo asks
    for the speed that makes good a part of the angle's error, its gain. A bound is one of impulse: each physics step of
    a call may give what the torque gives in the whole call.
    """

    joint_limits: Array
    """Lower and upper end of each joint in rad, (2, n_joints); infinite for a joint that turns without end."""

    def set_start(self) -> None:
        """Makes the present state the start."""

    def restart(self) -> None:
        """Puts everything back to the start."""

    def simulate(self, calls: int = 1) -> None:
        """Lets some calls of the simulator pass."""

    def close(self) -> None:
        """Ends the world."""

    def joint_states(self) -> tuple[Array, Array]:
        """Returns angles in rad and speeds in rad/s."""

    def base_pose(self) -> tuple[Point, Quaternion]:
        """Returns where the base is, in m, and its orientation, x, y, z, w."""

    def base_velocity(self) -> tuple[Point, Point]:
        """Returns the base's velocity in m/s and its angular velocity in rad/s, in world axes."""

    def link_position(self, link: str) -> Point:
        """Returns where the frame of a link is, in m."""

    def place_joints(self, angles: Array) -> None:
        """Puts the joints at angles, at rest."""

    def release(self) -> None:
        """Switches all motors off; joints turn freely."""

    def apply_torques(self, torques: Array) -> None:
        """Turns the joints by torques in N m during the next call, whatever their motors do."""

    def turn(self, speeds: Array, torque: float) -> None:
        """Lets the motors turn at speeds in rad/s, with a torque of so many N m at most."""

    def servo(self, angles: Array, torques: Array, gain: float = DEFAULT_GAIN) -> None:
        """Lets the motors go to angles in rad, each with a torque of so many N m at most."""

    def hold(self, angles: Mapping[int, float]) -> None:
        """Lets some motors, by their numbers, stay at angles in rad with :data:`HOLDING_TORQUE`."""

    def set_floor(self, friction: float, stiffness: float = 0.0, damping: float = 0.0) -> None:
        """Gives the floor its friction, which that of a link multiplies; stiffness in N/m, 0 is rigid, and N s/m."""

    def scale_masses(self, base: float, links: float) -> None:
        """Makes mass and inertia of the base, and of all other links, multiples of those described."""

    def add_damping(self, damping: float) -> None:
        """Adds damping in N m s/rad to that described for the motorised joints."""

    def paint(self, joints: frozenset[int]) -> None:
        """Gives the links behind these joints the colour of faulty ones, and all others their own."""

    def picture(self, camera: Camera) -> npt.NDArray[np.uint8]:
        """Returns a picture, (PICTURE_SIZE, PICTURE_SIZE, 3)."""
