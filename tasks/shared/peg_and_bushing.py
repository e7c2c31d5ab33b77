"""A bushing with its hole, and the peg: their shape, what may touch, and how hard the peg presses.

What is seen and what is touched differ: the bushing with its painted face, and the hidden hole,
which may be displaced from the paint.
"""

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hvs_suite.embodiment import Embodiment, Tool
from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.placing import RingSpec
from hvs_suite.tasks.shared.spec import scene

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.arena import Cell

FloatArray = npt.NDArray[np.float64]

WRENCH = "wrench"
"""What the tool feels, as an observation."""
FORCE_LOW_PASS_HZ = 50.0
BOTTOM_M = 0.003
"""Material below the hole; as the cell's, spelled out because that loads MuJoCo."""
MIN_CLEARANCE_MM = 0.05
"""What the physics was shown to hold."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PegSpec(RingSpec):
    """Parameters of a peg, of the compliant arm that holds it, and of a bushing on the ring.

    Attributes:
        peg_diameter_m: Diameter of the peg (m).
        peg_length_m: Its length (m).
        clearance_mm: By how much the hole's radius is larger (mm).
        chamfer_mm: Width and depth of the chamfer at the hole's mouth (mm).
        hole_depth_m: Depth of the hole (m).
        stiffness: Joint stiffness, as a share of the stiff position controller's.
        physics_hz: Physics steps a second.
    """

    target_diameter_m: float = 0.040
    peg_diameter_m: float = 0.010
    peg_length_m: float = scene(0.050)
    clearance_mm: float = 0.5
    chamfer_mm: float = 1.0
    hole_depth_m: float = 0.015
    stiffness: float = 0.05
    physics_hz: int = 480

    def __post_init__(self) -> None:
        """Refuse pegs and holes that cannot be, with a sentence.

        Raises:
            OptionError: One of them cannot.
        """
        super().__post_init__()
        self._check_positive("peg_diameter_m", "chamfer_mm")
        self._check("must lie between 0.01 and 1", lambda value: 0.01 <= value <= 1.0, "stiffness")
        self._check("must be at least 240", lambda value: value >= 240, "physics_hz")
        widest = 500.0 * (self.target_diameter_m - self.peg_diameter_m) - self.chamfer_mm
        if not MIN_CLEARANCE_MM <= self.clearance_mm < widest:
            raise OptionError(
                f"clearance_mm is {self.clearance_mm}; use {MIN_CLEARANCE_MM} (tighter the physics "
                f"does not hold) to {widest:.1f} mm, which a bushing of "
                f"{1000 * self.target_diameter_m:.0f} mm leaves"
            )
        if not self.hole_depth_m > 0.001 * self.chamfer_mm:
            raise OptionError(f"hole_depth_m is {self.hole_depth_m}; it is deeper than its chamfer")

    @property
    def embodiment(self) -> Embodiment:
        """The arm with the peg, compliant, and physics fine enough for contacts."""
        return Embodiment(
            tool=Tool(self.peg_diameter_m, self.peg_length_m),
            stiffness=self.stiffness,
            timestep_s=1.0 / self.physics_hz,
            impratio=10.0,
            noslip_iterations=0,
        )

    @property
    def top_m(self) -> float:
        """Height of the hole's mouth above the surface (m)."""
        return BOTTOM_M + self.hole_depth_m

    @property
    def caught_mm(self) -> float:
        """How far beside the axis the mouth still catches the peg (mm)."""
        return self.clearance_mm + self.chamfer_mm

    @property
    def hole_share(self) -> float:
        """Share of the bushing's face that its mouth takes."""
        mouth_m = self.peg_diameter_m + 0.002 * self.caught_mm
        return (mouth_m / self.target_diameter_m) ** 2


class PegAndBushing:
    """A bushing for the arm's peg.

    Args:
        cell: What it is attached to; its robot holds the peg.
        spec: Shape of both.

    Attributes:
        marker_geom: Index of the painted face in the compiled model.
        peak_n: The largest contact force since the episode began, after a low-pass (N).
    """

    def __init__(self, cell: "Cell", spec: PegSpec) -> None:
        from hvs_suite.cell.bushing import Bushing, Hole

        hole_diameter_m = spec.peg_diameter_m + 0.002 * spec.clearance_mm
        chamfer_m = 0.001 * spec.chamfer_mm
        shape = (spec.target_diameter_m, hole_diameter_m, spec.hole_depth_m, chamfer_m)
        self._bushing, self._hole = Bushing(*shape), Hole(*shape)
        cell.add_marker(self._bushing)
        cell.add_prop(self._hole)
        self._robot = cell.robot.mjcf_model
        self._contact = self._hole.add_force_sensor(cell, self._robot)

    def after_compile(self, physics: "mjcf.Physics") -> None:
        """Look up what may touch, and the sensors."""
        from hvs_suite.cell.tool import PEG_GEOMS, Wrench

        model = physics.model
        self._step_s = float(model.opt.timestep)
        self._sensor = int(model.sensor_adr[physics.bind(self._contact).element_id])
        self._wrench = Wrench(physics, self._robot)
        pegs = [self._robot.find("geom", name) for name in PEG_GEOMS]
        self._is_peg = np.zeros(model.ngeom, bool)
        self._is_peg[physics.bind(pegs).element_id] = True
        self._is_hole = np.zeros(model.ngeom, bool)
        self._is_hole[physics.bind(self._hole.geoms).element_id] = True
        self.marker_geom = int(physics.bind(self._bushing.geom).element_id)
        bodies = model.geom_bodyid[[self.marker_geom, int(np.argmax(self._is_hole))]]
        self._mocaps = model.body_mocapid[bodies]

    def begin(self, physics: "mjcf.Physics", painted: FloatArray, hole: FloatArray) -> None:
        """Begin an episode: put the bushing to one place (3,) m, its hole to another, feel nothing.

        Both are on the surface below.
        """
        import mujoco

        data = physics.data.ptr
        data.mocap_pos[self._mocaps] = [painted, hole]
        # The next picture shows the bodies where they were last computed.
        mujoco.mj_kinematics(physics.model.ptr, data)
        self._force = self.peak_n = self._felt_at_s = 0.0

    def touches_else(self, physics: "mjcf.Physics") -> bool:
        """Whether something else than peg and bushing touches something."""
        first, second = physics.data.ptr.contact.geom.T
        allowed = (self._is_peg[first] & self._is_hole[second]) | (
            self._is_hole[first] & self._is_peg[second]
        )
        return not allowed.all()

    def feel(self, physics: "mjcf.Physics") -> None:
        """Take in the contact force of the last physics step, through the low-pass.

        Asked for after steps with contact alone: in between the low-pass forgets.
        """
        data = physics.data.ptr
        force, time_s = data.sensordata[self._sensor : self._sensor + 3], data.time
        rate, step_s = 2.0 * math.pi * FORCE_LOW_PASS_HZ, self._step_s
        idle_s = max(time_s - self._felt_at_s - step_s, 0.0)
        keep = math.exp(-rate * step_s)
        pressed = (1.0 - keep) * float(np.linalg.norm(force))
        self._force = keep * math.exp(-rate * idle_s) * self._force + pressed
        self._felt_at_s = time_s
        self.peak_n = max(self.peak_n, self._force)

    def wrench(self, physics: "mjcf.Physics") -> FloatArray:
        """Force (N) and torque (Nm) on the tool at the flange, flange axes, (6,)."""
        return self._wrench.read(physics)
