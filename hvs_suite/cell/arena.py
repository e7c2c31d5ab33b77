"""The cell as one MJCF model: robot on its surface, marker, two cameras, light."""

from collections.abc import Sequence
from typing import Any

from dm_control import composer, mjcf

from hvs_suite.cell import cameras
from hvs_suite.cell.marker import Marker, MarkerKind
from hvs_suite.cell.robot import PHYSICS_TIMESTEP_S, Iiwa7
from hvs_suite.cell.surface import Surface, SurfaceShape


class Cell(composer.Arena):
    """Robot, surface, marker, cameras and light.

    Attributes:
        robot: The iiwa 7, its base at the origin.
        surface: The work surface.
        marker: The target, a mocap body.
        eih: MJCF camera in the hand.
        eth: MJCF camera over the cell, at its nominal pose.
        light: MJCF light over the cell.
    """

    def _build(
        self,
        *,
        surface: SurfaceShape,
        surface_size_m: tuple[float, float],
        marker: MarkerKind,
        target_diameter_m: float,
        eih_fov_deg: float,
        eth_fov_deg: float,
        eth_position_m: Sequence[float],
        eth_look_at_m: Sequence[float],
    ) -> None:
        """Builds the cell; the arguments are those of ``AlignVariant``."""
        super()._build(name="cell")
        root = self.mjcf_model
        root.option.timestep = PHYSICS_TIMESTEP_S
        root.option.integrator = "implicitfast"
        root.option.impratio = 1.0
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
        self.surface = Surface(shape=surface, size_m=surface_size_m)
        self.attach(self.surface)
        self.robot = Iiwa7()
        self.attach(self.robot)
        self.marker = Marker(kind=marker, diameter_m=target_diameter_m)
        self.attach(self.marker).mocap = True
        self.eih: Any = cameras.add_eye_in_hand(
            self.robot.flange_body, self.robot.flange, eih_fov_deg
        )
        self.eth: Any = cameras.add_eye_to_hand(root, eth_position_m, eth_look_at_m, eth_fov_deg)

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """Root of the cell's MJCF tree."""
        return super().mjcf_model
