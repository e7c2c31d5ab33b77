"""The cell as one MJCF model: robot on its surface, two cameras, light, and a family's markers."""

from collections.abc import Sequence
from typing import Any

from dm_control import composer, mjcf

from hvs_suite.cell import cameras
from hvs_suite.cell.arm import Iiwa7
from hvs_suite.cell.marker import Marker
from hvs_suite.cell.surface import Surface
from hvs_suite.embodiment import Embodiment


class Cell(composer.Arena):
    """Robot, surface, cameras and light.

    Attributes:
        robot: The iiwa 7, its base at the origin.
        surface: The work surface.
        markers: The targets that a family added, mocap bodies.
        eih: MJCF camera in the hand.
        eth: MJCF camera over the cell, at its nominal pose.
        light: MJCF light over the cell.
    """

    def _build(
        self,
        *,
        embodiment: Embodiment,
        surface: Surface,
        eih_fov_deg: float,
        eth_fov_deg: float,
        eth_position_m: Sequence[float],
        eth_look_at_m: Sequence[float],
    ) -> None:
        """Builds the cell.

        Args:
            embodiment: The robot.
            surface: What everything stands on.
            eih_fov_deg: As in ``Spec``; likewise the three below.
            eth_fov_deg: Field of view of the eye to hand.
            eth_position_m: Its nominal position.
            eth_look_at_m: Where it looks.
        """
        super()._build(name="cell")
        root = self.mjcf_model
        root.option.timestep = embodiment.timestep_s
        root.option.integrator = "implicitfast"
        root.option.impratio = embodiment.impratio
        root.option.noslip_iterations = embodiment.noslip_iterations
        # A fixed scale: near plane 5 mm (the surface is 50 mm from the lens at the goal), far 15 m.
        root.statistic.extent = 1.0
        root.statistic.center = [0, 0, 0.4]
        root.visual.map.znear = 0.005
        root.visual.map.zfar = 15.0
        # Half the width of the light's shadow map (m). A smaller, sharper one speckles the surface
        # with its own shadow wherever the light falls aslant.
        root.visual.map.shadowclip = 6.0
        root.visual.headlight.ambient = [0.35, 0.35, 0.35]
        root.visual.headlight.diffuse = [0.15, 0.15, 0.15]
        root.visual.headlight.specular = [0.0, 0.0, 0.0]
        # Coarse tessellation costs nothing to look at and halves the time of a frame.
        root.visual.quality.numslices = 20
        root.visual.quality.numstacks = 8
        root.asset.add(
            "texture",
            name="sky",
            type="skybox",
            builtin="gradient",
            rgb1=[0.80, 0.85, 0.90],
            rgb2=[0.45, 0.48, 0.52],
            width=64,
            height=384,
        )
        self.light = root.worldbody.add(
            "light",
            name="ceiling",
            pos=[0.8, -1.0, 3.0],
            dir=[-0.26, 0.32, -0.91],
            diffuse=[0.55, 0.55, 0.55],
            specular=[0.15, 0.15, 0.15],
            directional=True,
            castshadow=True,
        )
        self.surface = surface
        self.attach(self.surface)
        self.robot = Iiwa7(embodiment)
        self.attach(self.robot)
        self.markers: list[Marker] = []
        self.eih: Any = cameras.add_eye_in_hand(
            self.robot.flange_body, self.robot.flange, eih_fov_deg, embodiment
        )
        self.eth: Any = cameras.add_eye_to_hand(root, eth_position_m, eth_look_at_m, eth_fov_deg)

    def add_marker(self, marker: Marker) -> None:
        """Adds a target, a mocap body, so that moving it changes the state and not the model."""
        self.markers.append(marker)
        self.attach(marker).mocap = True

    def add_prop(self, prop: composer.Entity) -> None:
        """Adds a thing that scenes put somewhere, a mocap body too."""
        self.attach(prop).mocap = True

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """Root of the cell's MJCF tree."""
        return super().mjcf_model
