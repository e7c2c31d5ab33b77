"""The columns of a dataset: LeRobot's features, and the frame that fills them.

========================================  ==============  ========================================
feature                                   dtype, shape    meaning
========================================  ==============  ========================================
``observation.images.eih``, ``.eth``      image (H,W,3)   as the policy saw it
``observation.state``                     float32 (14,)   measured positions (rad), then velocities
``observation.<name>``                    float32 (k,)    what else the task's family shows
``action``                                float32 (7,)    what the demonstrator would do here
``next.reward``                           float32 (1,)    reward of the control step that followed
``next.done``, ``next.success``           bool (1,)       whether that step ended, or reached it
``privileged.action_executed``            float32 (7,)    what was done; differs where noise was on
``privileged.scenario``                   int64 (1,)      index in the split
``privileged.goal_position``              float32 (3,)    of the flange at the goal (m, base frame)
``privileged.goal_normal``                float32 (3,)    outward surface normal there
``privileged.joint_offset``               float32 (7,)    zero errors of the encoders (rad), if any
``privileged.goal_unseen``                float32 (3,)    goal less where pictures show it, if it is
``privileged.<keypoint>_<camera>``        float32 (4,)    in the image: u, v, diameter, seen
``privileged.errors``                     float32 (k,)    the task's metrics at this frame
========================================  ==============  ========================================

Which keypoints, metrics and further privileged columns there are, the task's spec declares.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.spec import Spec

ROBOT_TYPE = "kuka_lbr_iiwa"
# Written out instead of imported, because robot.py loads MuJoCo, which reading a dataset must not.
JOINT_NAMES = ("A1", "A2", "A3", "A4", "A5", "A6", "A7")
CAMERAS = ("eih", "eth")

OBSERVATION = "observation."
IMAGES = "observation.images."
STATE = "observation.state"
ACTION = "action"
PRIVILEGED = "privileged."
ACTION_EXECUTED = f"{PRIVILEGED}action_executed"
SCENARIO = f"{PRIVILEGED}scenario"
ERRORS = f"{PRIVILEGED}errors"

_STATE_SUFFIX = {"joint_positions": "pos", "joint_velocities": "vel"}

Frame = dict[str, npt.NDArray[Any]]


def image_key(camera: str) -> str:
    """Feature of a camera's images."""
    return f"{IMAGES}{camera}"


def vector_key(name: str) -> str:
    """Feature of a vector that a family shows beside cameras and joints."""
    return f"{OBSERVATION}{name}"


def dataset_features(spec: Spec) -> dict[str, dict[str, Any]]:
    """The features of a dataset of this task, in LeRobot's form.

    Raises:
        OptionError: The task observes what a LeRobot dataset cannot hold, or takes other actions
            than the expert's.
    """
    names = spec.observed
    channels = {"eih": spec.eih_channels, "eth": spec.eth_channels}
    further = spec.further_observations
    unfit = [name for name in names if name not in (*CAMERAS, *_STATE_SUFFIX, *further)]
    unfit += [f"{name}_channels=1" for name in names if channels.get(name, 3) != 3]
    unfit += ["normalise_observation=True"] if spec.normalise_observation else []
    unfit += [] if spec.action_mode == "joint_position" else [f"{spec.action_mode} actions"]
    if unfit:
        raise OptionError(
            "a dataset holds uint8 RGB images, joint values in rad and joint_position actions; "
            f"leave out {', '.join(unfit)}"
        )
    sides = {"eih": spec.eih_resolution, "eth": spec.eth_resolution}
    features: dict[str, dict[str, Any]] = {
        image_key(name): {
            "dtype": "image",
            "shape": (sides[name], sides[name], 3),
            "names": ["height", "width", "channels"],
        }
        for name in names
        if name in CAMERAS
    }
    state = [f"{joint}.{_STATE_SUFFIX[n]}" for n in _state_names(spec) for joint in JOINT_NAMES]
    if state:
        features[STATE] = _vector(state)
    for name in names:
        if name in further:
            features[vector_key(name)] = _vector(list(further[name].dimensions))
    features[ACTION] = _vector([f"{joint}.pos" for joint in JOINT_NAMES])
    features["next.reward"] = _scalar("float32", "reward")
    features["next.done"] = _scalar("bool", "done")
    features["next.success"] = _scalar("bool", "success")
    features[ACTION_EXECUTED] = _vector([f"{joint}.pos" for joint in JOINT_NAMES])
    features[SCENARIO] = _scalar("int64", "scenario")
    for name, dimensions in spec.privileged.items():
        features[f"{PRIVILEGED}{name}"] = _vector(list(dimensions))
    features[ERRORS] = _vector([metric.name for metric in spec.metrics])
    return features


def observed_part(
    spec: Spec, observation: Mapping[str, npt.NDArray[Any]], environment: Any
) -> Frame:
    """The columns that are known before the action: observation and privileged values.

    Args:
        spec: The task's parameters.
        observation: What the policy sees.
        environment: The environment in that state.
    """
    frame: Frame = {image_key(name): observation[name] for name in CAMERAS if name in observation}
    names = _state_names(spec)
    if names:
        frame[STATE] = np.concatenate([observation[name] for name in names]).astype(np.float32)
    for name in spec.further_observations:
        if name in spec.observed:
            frame[vector_key(name)] = observation[name].astype(np.float32)
    truth, info = environment.privileged(), environment.info
    for name in spec.privileged:
        frame[f"{PRIVILEGED}{name}"] = truth[name].astype(np.float32)
    errors = [info["errors"][metric.name] for metric in spec.metrics]
    frame[ERRORS] = np.array(errors, np.float32)
    frame[SCENARIO] = np.array([info["scenario"]], np.int64)
    return frame


def acted_part(
    action: npt.NDArray[np.float32],
    executed: npt.NDArray[np.float32],
    reward: float,
    done: bool,
    success: bool,
) -> Frame:
    """The columns that are known after the control step.

    Args:
        action: The demonstrator's action (7,).
        executed: The action done (7,).
        reward: Reward of the step.
        done: The step ended the episode.
        success: The step reached the goal.
    """
    return {
        ACTION: action,
        ACTION_EXECUTED: executed,
        "next.reward": np.array([reward], np.float32),
        "next.done": np.array([done], np.bool_),
        "next.success": np.array([success], np.bool_),
    }


def _state_names(spec: Spec) -> list[str]:
    """The joint observations of a task, positions first."""
    names = spec.observed
    return [name for name in _STATE_SUFFIX if name in names]


def _vector(names: list[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (len(names),), "names": names}


def _scalar(dtype: str, name: str) -> dict[str, Any]:
    return {"dtype": dtype, "shape": (1,), "names": [name]}
