"""Ways into a hole: the expert's, and the one that demonstrations show."""

import numpy as np
import numpy.typing as npt
import pytest

import hvs_suite
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.robot import JOINT_ACCELERATION_RAD_S2
from hvs_suite.datasets.expert import Expert
from hvs_suite.datasets.insertion import SLIDE_MM, GuardedInsertion
from hvs_suite.datasets.looking import Demonstrator
from hvs_suite.registry import TASKS
from hvs_suite.tasks.insert import InsertSpec
from hvs_suite.tasks.shared.goal import UP, Goal

HEIGHT_M = 0.04


def sent_from(
    task: str, beside_m: float, height_m: float, way: str, pressed_n: float = 0.0
) -> npt.NDArray[np.float64]:
    """Where the tip is sent by the goal (mm), from where it and its set point stand."""
    spec = TASKS[task]
    assert isinstance(spec, InsertSpec)
    model = kinematics(spec.embodiment)
    insertion = GuardedInsertion(spec.control_period_s, spec.embodiment)
    goal = Goal(np.array([0.6, 0.1, 0.05]), UP, -spec.goal_depth_m)
    above = model.goal_configurations_at_tool_angle(goal.target + HEIGHT_M * UP, UP, 0.0)
    posture = above[np.abs(above).max(axis=1).argmin()]
    place = goal.target + np.array([beside_m, 0.0, height_m])
    q = model.nearest_configuration(posture, place, UP, JOINT_ACCELERATION_RAD_S2)
    assert q is not None
    still = np.zeros(7)
    sent = (
        insertion.next_set_point(q, still, q, goal)
        if way == "expert"
        else insertion.learnable_set_point(
            q, still, q, goal, spec.caught_mm, pressed_n=pressed_n if way == "gentle" else None
        )
    )
    return np.asarray(1000.0 * (model.tip_pose(sent)[1] - goal.target))


def next_heights(way: str) -> list[float]:
    """Heights (mm) that the tip is sent to, 0.4 and 0.6 mm beside the axis."""
    return [sent_from("insert-wide", beside, HEIGHT_M, way)[2] for beside in (0.0004, 0.0006)]


def test_a_way_that_can_be_learned_does_not_turn_back_at_half_a_millimetre() -> None:
    left, right = next_heights("learnable")
    assert abs(left - right) < 1.0
    assert max(left, right) < 1000.0 * HEIGHT_M - 5.0
    left, right = next_heights("expert")
    assert right - left > 5.0


@pytest.mark.parametrize("task", ["insert-wide", "insert-jig"])
def test_demonstrations_go_into_the_hole(task: str) -> None:
    with hvs_suite.load(task, split="dev") as env:
        env.draws = False
        for scenario in range(2):
            demonstrator = Demonstrator(env)
            time_step = env.reset(scenario=scenario)
            while not time_step.last():
                time_step = env.step(demonstrator.label())
            assert env.info["is_success"]


def test_demonstrations_press_gently_where_the_paint_says() -> None:
    with hvs_suite.load("insert-feel", split="dev") as env:
        env.draws = False
        hidden = [
            index
            for index in range(20)
            if np.hypot(*env.task.source.draw(index).hole_offset) > 0.0008
        ]
        for scenario in hidden[:2]:
            demonstrator = Demonstrator(env)
            time_step = env.reset(scenario=scenario)
            while not time_step.last():
                time_step = env.step(demonstrator.label())
            painted = env.task.family.keypoints()["target"].position
            beside = env.tip().position - painted
            # What it presses with bends the arm sideways, and it lets the tip slide so far.
            assert np.hypot(*beside[:2]) < 0.001 * SLIDE_MM
            assert abs(beside[2]) < 0.0005
            assert not env.info["overload"]
            assert env.info["errors"]["peak_force_n"] > 5.0


def test_one_that_presses_gently_slides_over_the_face_and_does_not_go_up() -> None:
    assert sent_from("insert-feel", 0.001, 0.0, "gentle")[2] < -0.9
    assert sent_from("insert-feel", 0.001, 0.0005, "learnable")[2] > 1.0


def test_one_that_presses_gently_goes_where_the_mouth_leads_it() -> None:
    on_face, in_mouth = (
        sent_from("insert-feel", 0.0005, height, "gentle") for height in (0.0, -0.001)
    )
    assert abs(on_face[0]) < 0.05
    assert abs(in_mouth[0] - 0.5) < 0.05


def test_one_that_presses_gently_goes_faster_in_the_hole() -> None:
    on_face, in_hole = (
        sent_from("insert-feel", 0.0, height, "gentle")[2] for height in (0.0, -0.005)
    )
    assert on_face == pytest.approx(-1.0, abs=0.1)
    assert in_hole == pytest.approx(-5.0 - 3.0, abs=0.1)


@pytest.mark.parametrize(("pressed_n", "deeper_mm"), [(17.0, 1.0), (19.5, 0.5), (22.0, 0), (30, 0)])
def test_the_harder_it_is_pressed_on_the_slower_it_goes_down(
    pressed_n: float, deeper_mm: float
) -> None:
    sent = sent_from("insert-feel", 0.0, 0.0, "gentle", pressed_n)
    assert sent[2] == pytest.approx(-deeper_mm, abs=0.1)


def test_demonstrations_pass_higher_over_the_table_than_the_expert() -> None:
    lowest = {}
    with hvs_suite.load("sequence-thesis", split="dev") as env:
        env.draws = False
        for kind in (Expert, Demonstrator):
            heights = []
            for scenario in range(4):
                guide = kind(env)
                time_step = env.reset(scenario=scenario)
                while not time_step.last():
                    time_step = env.step(guide.label())
                    heights.append(env.tip().position[2])
                assert env.info["is_success"]
            lowest[kind] = min(heights)
    assert lowest[Expert] < 0.025
    assert lowest[Demonstrator] > 0.025
