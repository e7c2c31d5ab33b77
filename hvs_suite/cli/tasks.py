"""``hvs tasks``: the named tasks and what each of them fixes."""

import dataclasses
from typing import TYPE_CHECKING

from hvs_suite.cli import console

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.spec import Spec


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tasks:
    """List the named tasks.

    Attributes:
        json: Print every parameter of every task as JSON.
    """

    json: bool = False

    def run(self) -> None:
        """Print the table or the JSON document."""
        import hvs_suite

        variants = hvs_suite.TASKS.values()
        if self.json:
            console.print_json(
                [dataclasses.asdict(v) | {"instruction": v.instruction()} for v in variants]
            )
            return
        console.print_table(
            ("task", "start", "target", "tolerance", "held", "steps", "EIH, ETH px", "varied"),
            [
                (
                    f"{v.name}-v{v.version}",
                    _words(v.start),
                    f"{_words(v.goal)}, {v.target_diameter_m * 1000:.0f} mm {v.marker}",
                    tolerance(v),
                    str(v.hold_steps),
                    f"{v.time_limit_steps} x {v.control_period_s:g} s",
                    f"{v.eih_resolution}, {v.eth_resolution}",
                    disturbances(v),
                )
                for v in variants
            ],
        )


def tolerance(variant: "Spec") -> str:
    """A variant's tolerances in words, such as ``1 mm, 1 deg``."""
    parts = []
    if variant.position_tolerance_mm is not None:
        parts.append(f"{variant.position_tolerance_mm:g} mm")
    if variant.lateral_tolerance_mm is not None:
        parts.append(f"{variant.lateral_tolerance_mm:g} mm sideways")
    if variant.height_tolerance_mm is not None:
        parts.append(f"{variant.height_tolerance_mm:g} mm in height")
    return ", ".join([*parts, f"{variant.tilt_tolerance_deg:g} deg"])


def disturbances(variant: "Spec") -> str:
    """What a variant varies besides start and goal, in words; a dash for nothing."""
    present = {
        "light": variant.vary_light,
        "colour": variant.vary_colour,
        "texture": variant.vary_texture,
        "ETH pose": variant.eth_position_noise_m > 0 or variant.eth_rotation_noise_deg > 0,
        "image noise": variant.image_noise > 0,
        "joint offsets": variant.joint_offset_deg > 0,
        "latency": variant.latency_steps > 0,
    }
    return ", ".join(name for name, there in present.items() if there) or "-"


def _words(choice: object) -> str:
    """A start or goal option as text; numbers as a list."""
    if isinstance(choice, tuple):
        return "(" + ", ".join(f"{number:g}" for number in choice) + ")"
    return str(choice)
