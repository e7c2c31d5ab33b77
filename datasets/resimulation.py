"""Playing a recorded episode again: do its executed actions lead where the dataset says?

The scene follows from task, options, split and scenario alone, and physics is deterministic, so
every privileged value, state and outcome must come out as recorded. Pictures may differ by what
another graphics driver rounds.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hvs_suite.datasets.features import (
    ACTION_EXECUTED,
    CAMERAS,
    ERRORS,
    PRIVILEGED,
    SCENARIO,
    STATE,
    Frame,
    acted_part,
    image_key,
    observed_part,
    vector_key,
)

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment
    from hvs_suite.tasks.shared.spec import Spec

# Positions in rad and m, images in px, errors in mm and deg: far below every tolerance of a task,
# far above what another build of the libraries rounds in float32.
TOLERANCE = 1e-4
TOLERANCES: Mapping[str, float] = {
    STATE: 1e-4,
    ERRORS: 2e-3,
}
OUTCOMES = ("next.reward", "next.done", "next.success")
IN_IMAGE_TOLERANCE = 2e-2
"""Where a keypoint is in a picture, in shares of half its width."""
IMAGE_TOLERANCE = 1.0
"""Mean difference of a lossless picture (grey levels of 255); another frame differs by more."""
VIDEO_TOLERANCE = 8.0
"""The same for a compressed one."""


@dataclasses.dataclass(frozen=True)
class Difference:
    """Where re-simulation first leaves the record of one column.

    Attributes:
        frame: The frame.
        column: The column.
        what: What differs, in words.
    """

    frame: int
    column: str
    what: str


def resimulate(
    env: "Environment",
    spec: "Spec",
    columns: Mapping[str, npt.NDArray[Any]],
    features: Mapping[str, Mapping[str, Any]],
    *,
    picture: Callable[[str, int], npt.NDArray[np.uint8] | None] | None = None,
    lossy: bool = False,
) -> list[Difference]:
    """Plays one episode's executed actions and compares every frame.

    Args:
        env: The task with the dataset's split and options.
        spec: The dataset's task with all its observations.
        columns: The episode's columns, (n, k) or (n,).
        features: LeRobot's features, for the names of dimensions.
        picture: Returns the recorded picture of (camera's feature, frame), or None where it is
            damaged; without it pictures are not compared.
        lossy: Pictures were compressed.

    Returns:
        The first difference of each column, by frame.
    """
    found: dict[str, Difference] = {}
    executed = np.asarray(columns[ACTION_EXECUTED], np.float32)
    time_step = env.reset(scenario=int(np.ravel(columns[SCENARIO])[0]))
    for frame, action in enumerate(executed):
        if time_step.last():
            found["next.done"] = Difference(
                frame, "next.done", f"the episode goes on, re-simulated it ends at {frame - 1}"
            )
            break
        seen: Frame = observed_part(spec, _without_pictures(time_step.observation), env)
        if picture is not None:
            _compare_pictures(found, frame, time_step.observation, picture, lossy)
        time_step = env.step(action)
        seen |= acted_part(
            action,
            action,
            float(time_step.reward or 0.0),
            time_step.last(),
            env.info["is_success"],
        )
        vectors = (STATE, *map(vector_key, spec.further_observations))
        truths = (f"{PRIVILEGED}{name}" for name in spec.privileged)
        for name in (*vectors, ERRORS, *truths, *OUTCOMES):
            if name in columns and name in seen and name not in found:
                _compare(found, frame, name, columns[name][frame], seen[name], features)
    return sorted(found.values(), key=lambda each: (each.frame, each.column))


def _without_pictures(
    observation: Mapping[str, npt.NDArray[Any]],
) -> dict[str, npt.NDArray[Any]]:
    return {name: value for name, value in observation.items() if name not in CAMERAS}


def _compare(
    found: dict[str, Difference],
    frame: int,
    name: str,
    recorded: Any,
    seen: npt.NDArray[Any],
    features: Mapping[str, Mapping[str, Any]],
) -> None:
    """Notes a difference beyond the column's tolerance, with the dimension that differs most."""
    recorded = np.atleast_1d(recorded).astype(np.float64)
    expected = seen.astype(np.float64)
    names = features.get(name, {}).get("names") or [str(i) for i in range(len(expected))]
    tolerance = IN_IMAGE_TOLERANCE if "visible" in names else TOLERANCES.get(name, TOLERANCE)
    # NaN in the record is a difference as well.
    away = np.abs(recorded - expected)
    if recorded.shape == expected.shape and np.all(away <= tolerance):
        return
    worst = int(np.argmax(np.nan_to_num(away, nan=np.inf)))
    found[name] = Difference(
        frame,
        name,
        f"{names[worst]} is {recorded[worst]:.6g}, re-simulated {expected[worst]:.6g}",
    )


def _compare_pictures(
    found: dict[str, Difference],
    frame: int,
    observation: Mapping[str, npt.NDArray[Any]],
    picture: Callable[[str, int], npt.NDArray[np.uint8] | None],
    lossy: bool,
) -> None:
    """Notes a picture that shows something else than the scene."""
    for camera in CAMERAS:
        key = image_key(camera)
        if camera not in observation or key in found:
            continue
        recorded = picture(key, frame)
        if recorded is None or recorded.shape != observation[camera].shape:
            continue
        away = float(np.abs(recorded.astype(np.int16) - observation[camera]).mean())
        if away > (VIDEO_TOLERANCE if lossy else IMAGE_TOLERANCE):
            found[key] = Difference(
                frame, key, f"shows another scene, {away:.1f} grey levels from re-simulation"
            )
