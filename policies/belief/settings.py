"""What a checkpoint's ``config.json`` says of the network: its inputs, its sizes and the cell.

Whoever makes a network from settings, LeRobot's configuration or a stranger's file, has them
checked here.
"""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from hvs_suite.datasets.features import IMAGES, OBSERVATION, STATE
from hvs_suite.policies.belief.choice import FAR_M
from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork, CellModel, Shape

CAMERAS = ("eih", "eth")
STATE_SIZE = 2 * N_JOINTS
WRENCH_SIZE = 6
_MOST_SIZE = 4096
_MOST_PAST = 100
_ORTHONORMAL = 1e-6

Size = Annotated[int, pydantic.Field(strict=True, ge=1, le=_MOST_SIZE)]
Width = Annotated[int, pydantic.Field(strict=True, ge=4, le=_MOST_SIZE)]
Coordinate = Annotated[float, pydantic.Field(strict=True, ge=-10.0, le=10.0)]
Cosine = Annotated[float, pydantic.Field(strict=True, ge=-1.0 - 1e-9, le=1.0 + 1e-9)]
Tangent = Annotated[float, pydantic.Field(strict=True, ge=0.01, le=100.0)]
Angle = Annotated[float, pydantic.Field(strict=True, ge=-4.0, le=4.0)]
Period = Annotated[float, pydantic.Field(strict=True, ge=1e-3, le=10.0)]
StepLength = Annotated[float, pydantic.Field(strict=True, gt=0.0, le=0.1)]
Place = tuple[Coordinate, Coordinate, Coordinate]
Axes = tuple[tuple[Cosine, Cosine, Cosine], tuple[Cosine, Cosine, Cosine],
             tuple[Cosine, Cosine, Cosine]]  # fmt: skip


class Cell(pydantic.BaseModel):
    """A `CellModel` as plain numbers, of a size that a cell can have."""

    model_config = pydantic.ConfigDict(extra="forbid")

    period_s: Period
    latency_steps: Annotated[int, pydantic.Field(strict=True, ge=0, le=100)]
    lead_s: Annotated[float, pydantic.Field(strict=True, ge=0.0, le=1.0)]
    tool_length_m: Annotated[float, pydantic.Field(strict=True, ge=0.0, le=2.0)]
    tan: dict[str, Tangent]
    eth_origin: Place
    eth_rotation: Axes
    eih_origin: Place
    eih_rotation: Axes
    look_out_rad: tuple[Angle, Angle, Angle, Angle, Angle, Angle, Angle] | None = None
    over_m: Annotated[float, pydantic.Field(strict=True, gt=0.0, le=1.0)] | None = None

    @pydantic.field_validator("eth_rotation", "eih_rotation")
    @classmethod
    def _turns(cls, value: Axes) -> Axes:
        R = np.array(value)
        if not np.allclose(R @ R.T, np.eye(3), atol=_ORTHONORMAL) or np.linalg.det(R) < 0:
            raise ValueError("is no rotation")
        return value

    def model(self) -> CellModel:
        """The same as the network takes it."""
        return CellModel(**self.model_dump())


def as_numbers(cell: CellModel) -> dict[str, Any]:
    """A cell as ``config.json`` keeps it: numbers, lists and names."""
    return Cell(**dataclasses.asdict(cell)).model_dump(mode="json")


class _Feature(pydantic.BaseModel):
    shape: Annotated[tuple[Size, ...], pydantic.Field(min_length=1, max_length=4)]


class Settings(pydantic.BaseModel):
    """What decides which network there is.

    Attributes:
        input_features: Key to shape: images (C, H, H), the state (14,), and what the keys below
            name.
        channels: Channels of the eyes.
        hidden: Width of the head.
        error_scale: See `Shape`.
        goal_key: Input that says which target is meant, one-hot; None without.
        wrench_key: Input that holds force and torque, (6,); None without.
        control_period_s: Has to be that of the cell.
        cell: What is known of the cell.
        residual_hidden: See `Shape`.
        residual_step_m: See `Shape`.
        residual_reach_m: See `Shape`.
        choice_beyond_m: See `Shape`.
        reads_positions: See `Shape`.
        reads_velocities: See `Shape`.
        slopes: See `Shape`.
        slopes_by: See `Shape`.
        offsets: See `Shape`.
        foresight: See `Shape`.
        remembers: See `Shape`.
        corrects_within_m: See `Shape`.
        elbow_aside: See `Shape`.
    """

    model_config = pydantic.ConfigDict(extra="ignore")

    input_features: dict[str, _Feature]
    channels: Width
    hidden: Width
    error_scale: Annotated[float, pydantic.Field(strict=True, ge=1e-9, le=1e3)]
    goal_key: Annotated[str, pydantic.StringConstraints(strict=True, max_length=100)] | None
    wrench_key: Annotated[str, pydantic.StringConstraints(strict=True, max_length=100)] | None
    control_period_s: Period
    cell: Cell
    residual_hidden: Annotated[int, pydantic.Field(strict=True, ge=0, le=_MOST_SIZE)] = 0
    residual_step_m: tuple[StepLength, StepLength] = Shape.residual_step_m
    residual_reach_m: Annotated[float, pydantic.Field(strict=True, gt=0.0, le=10.0)] = (
        Shape.residual_reach_m
    )
    choice_beyond_m: Annotated[float, pydantic.Field(strict=True, gt=0.0, lt=FAR_M)] | None = None
    reads_positions: Annotated[bool, pydantic.Field(strict=True)] = True
    reads_velocities: Annotated[bool, pydantic.Field(strict=True)] = True
    slopes: tuple[Literal["eih", "eth"], ...] = ()
    slopes_by: Literal["contrasts", "colour"] = "contrasts"
    offsets: tuple[Literal["eih", "eth"], ...] = ()
    foresight: Annotated[int, pydantic.Field(strict=True, ge=0, le=_MOST_PAST)] = 0
    remembers: Annotated[bool, pydantic.Field(strict=True)] = True
    corrects_within_m: Annotated[float, pydantic.Field(gt=0.0, le=10.0)] | None = None
    elbow_aside: Annotated[bool, pydantic.Field(strict=True)] = False

    @pydantic.model_validator(mode="after")
    def _fit(self) -> "Settings":
        cameras = self._cameras()
        if not cameras:
            raise ValueError(f"it needs {' or '.join(IMAGES + name for name in CAMERAS)}")
        wanted: dict[str, tuple[int, ...]] = {STATE: (STATE_SIZE,)}
        if self.wrench_key is not None:
            wanted[self.wrench_key] = (WRENCH_SIZE,)
        if self.goal_key is not None:
            wanted[self.goal_key] = self._shape(self.goal_key)[:1]
        for name, (channels, side) in cameras.items():
            wanted[IMAGES + name] = (channels, side, side)
            if name not in CAMERAS or name not in self.cell.tan:
                raise ValueError(f"it knows no camera {name[:80]!r}")
        for key, shape in wanted.items():
            if self._shape(key) != shape:
                raise ValueError(f"{key[:80]} must have shape {shape}, not {self._shape(key)}")
        if further := sorted(self.input_features.keys() - wanted.keys()):
            raise ValueError(f"it has no use for {further[0][:80]!r}")
        if missing := sorted({*self.slopes, *self.offsets} - {*cameras}):
            raise ValueError(f"it has no camera {missing[0]!r}")
        if self.cell.period_s != self.control_period_s:
            raise ValueError(
                f"the cell has control steps of {self.cell.period_s:g} s, the policy of "
                f"{self.control_period_s:g} s"
            )
        return self

    def _shape(self, key: str) -> tuple[int, ...]:
        feature = self.input_features.get(key)
        return () if feature is None else feature.shape

    def _cameras(self) -> dict[str, tuple[int, int]]:
        return {
            key.removeprefix(IMAGES): (feature.shape[0], feature.shape[-1])
            for key, feature in sorted(self.input_features.items())
            if key.startswith(IMAGES)
        }

    def shape(self) -> Shape:
        """Sizes of the network."""
        return Shape(
            self._cameras(),
            n_goals=0 if self.goal_key is None else self._shape(self.goal_key)[0],
            n_felt=0 if self.wrench_key is None else WRENCH_SIZE,
            channels=self.channels,
            hidden=self.hidden,
            error_scale=self.error_scale,
            residual_hidden=self.residual_hidden,
            residual_step_m=self.residual_step_m,
            residual_reach_m=self.residual_reach_m,
            choice_beyond_m=self.choice_beyond_m,
            reads_positions=self.reads_positions,
            reads_velocities=self.reads_velocities,
            slopes=self.slopes,
            slopes_by=self.slopes_by,
            offsets=self.offsets,
            foresight=self.foresight,
            remembers=self.remembers,
            corrects_within_m=self.corrects_within_m,
            elbow_aside=self.elbow_aside,
        )

    def network(self) -> BeliefNetwork:
        """A new network."""
        return BeliefNetwork(self.shape(), self.cell.model())


def further_keys(keys: Mapping[str, object]) -> tuple[str | None, str | None]:
    """Which inputs say what is meant and what is felt, by their names.

    Args:
        keys: Inputs of a policy, or columns of a dataset, by key.

    Returns:
        ``observation.<...goal...>`` and ``observation.wrench``; None for what is not there.
    """
    vectors = [
        key.removeprefix(OBSERVATION)
        for key in sorted(keys)
        if key.startswith(OBSERVATION) and not key.startswith(IMAGES)
    ]
    goal = next((name for name in vectors if "goal" in name), None)
    wrench = next((name for name in vectors if name == "wrench"), None)
    named = [None if name is None else OBSERVATION + name for name in (goal, wrench)]
    return named[0], named[1]
