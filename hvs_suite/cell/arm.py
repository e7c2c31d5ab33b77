"""The arm as a composer entity: the robot's tree with its visual shells."""

from typing import Any

from dm_control import composer, mjcf

from hvs_suite.cell import robot
from hvs_suite.cell.shells import add_shells
from hvs_suite.cell.tool import add_tool_shells
from hvs_suite.embodiment import BARE_ARM, Embodiment


class Iiwa7(composer.Entity):
    """The arm as a composer entity; its model origin is the base frame.

    The gains are made for the embodiment's timestep and ``implicitfast``: the model that it is
    attached to has to set both. At every reset set ``physics.bind(arm.actuators).act`` to the
    joint positions: MuJoCo's default of 0 would throw the arm.
    """

    def _build(self, embodiment: Embodiment = BARE_ARM, shells: bool = True) -> None:
        """Builds the model.

        Args:
            embodiment: Tool and gains.
            shells: Add the visual shells; without them only collision geoms (hidden) exist.
        """
        self._embodiment = embodiment
        self._root = robot.robot_tree(embodiment)
        self._shell_geoms: tuple[Any, ...] = ()
        if shells:
            self._shell_geoms = add_shells(self._root)
            if embodiment.tool is not None:
                add_tool_shells(self._root, embodiment, robot.SHELL_GROUP)

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """Root of the robot's MJCF tree."""
        return self._root

    @property
    def joints(self) -> tuple[Any, ...]:
        """The joints A1 to A7."""
        return tuple(self._root.find("joint", name) for name in robot.JOINT_NAMES)

    @property
    def actuators(self) -> tuple[Any, ...]:
        """The ``intvelocity`` actuators A1 to A7: control is a set-point speed (rad/s)."""
        return tuple(self._root.find("actuator", name) for name in robot.JOINT_NAMES)

    @property
    def flange(self) -> Any:
        """Site at the flange face centre, +z out along the tool axis."""
        return self._root.find("site", "flange")

    @property
    def tip(self) -> Any:
        """Site at the tool's tip; the flange's where there is no tool."""
        return self._root.find("site", robot.tip_name(self._embodiment))

    @property
    def flange_body(self) -> Any:
        """Link 7, which carries the flange."""
        return self._root.find("body", "link_7")

    @property
    def shell_geoms(self) -> tuple[Any, ...]:
        """The visual geoms; empty without shells."""
        return self._shell_geoms
