"""The arm's state as a policy can know it: measured joints, and set points that it remembers."""

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.robot import JOINT_RANGE_RAD, after_commands, set_point_after

FloatArray = npt.NDArray[np.float64]

_MAX_LATENCY = 3
_MOVED_SHARE = 0.1
"""A first move of less than this share of the commanded one is still to come."""


class Belief:
    """The arm's state as the policy can know it.

    Set points are remembered rather than seen: they move towards each command within the joint
    speed limits. Whether commands act at once or a control step later shows in when the arm first
    moves.

    Args:
        period_s: Control period (s).

    Attributes:
        joint_positions: Measured, (7,) rad.
        joint_velocities: Measured, (7,) rad/s.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self.joint_positions: FloatArray = np.zeros(7)
        self.joint_velocities: FloatArray = np.zeros(7)
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        self._start: FloatArray | None = None
        self._commands: list[FloatArray] = []
        self._latency = 0
        self._has_moved = False

    def measure(self, positions: FloatArray, velocities: FloatArray) -> None:
        """Take in measured joint angles (7,) rad and speeds (7,) rad/s."""
        self.joint_positions = positions
        self.joint_velocities = velocities
        if self._start is None:
            self._start = positions
        if self._commands and not self._has_moved:
            # The commands so far, had they acted at once, would have moved the set point so far.
            way = np.abs(self._tracked(self._commands) - self._start).max()
            moved = np.abs(positions - self._start).max()
            if moved > _MOVED_SHARE * way:
                self._has_moved = True
            else:
                self._latency = min(len(self._commands), _MAX_LATENCY)

    def command(self, action: npt.NDArray[np.float32]) -> None:
        """Remember an action, (7,) in [-1, 1]."""
        self._commands.append(action.astype(np.float64) * JOINT_RANGE_RAD)

    def overrule(self, action: npt.NDArray[np.float32]) -> None:
        """Remember an action, (7,) in [-1, 1], in place of the last."""
        self._commands.pop()
        self.command(action)

    @property
    def latency_steps(self) -> int:
        """Control steps between a command and its effect, as far as it was noticed."""
        return self._latency

    @property
    def setpoint(self) -> FloatArray:
        """Set point that the controller tracks now, (7,) rad."""
        return self._tracked(self._commands[: len(self._commands) - self._latency])

    @property
    def pending_setpoints(self) -> list[FloatArray]:
        """Set points commanded that do not act yet, oldest first."""
        return self._commands[len(self._commands) - self._latency :]

    def when_action_acts(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Joint angles (rad), speeds (rad/s) and set point (rad), (7,) each, at that moment."""
        return after_commands(
            self.joint_positions,
            self.joint_velocities,
            self.setpoint,
            self.pending_setpoints,
            self._period_s,
        )

    def _tracked(self, commands: list[FloatArray]) -> FloatArray:
        assert self._start is not None
        set_point = self._start
        for command in commands:
            set_point = set_point_after(set_point, command, self._period_s)
        return set_point
