"""What a policy may know of the cell beforehand: its nominal geometry."""

import math

import numpy as np

from hvs_suite.cell.cameras import look_at
from hvs_suite.datasets.flyover import OVER_M, leads_over
from hvs_suite.datasets.looking import LOOK_OUT_RAD
from hvs_suite.datasets.planner import LEAD_S
from hvs_suite.policies.belief.network import CellModel
from hvs_suite.tasks.shared.spec import Spec

_OPTICAL = np.diag([1.0, -1.0, -1.0])


def cell_model(spec: Spec) -> CellModel:
    """The cell of a task as it is drawn up.

    Args:
        spec: Its parameters.
    """
    eth = look_at(spec.eth_position_m, spec.eth_look_at_m) @ _OPTICAL
    axes, place = spec.embodiment.hand_eye
    return CellModel(
        period_s=spec.control_period_s,
        latency_steps=spec.latency_steps,
        lead_s=LEAD_S * spec.embodiment.slowness,
        tool_length_m=spec.embodiment.tool_length_m,
        tan={
            name: math.tan(math.radians(getattr(spec, f"{name}_fov_deg")) / 2.0)
            for name in ("eih", "eth")
        },
        eth_origin=tuple(spec.eth_position_m),
        eth_rotation=tuple(map(tuple, eth.tolist())),
        eih_origin=tuple(place.tolist()),
        eih_rotation=tuple(map(tuple, axes.tolist())),
        look_out_rad=tuple(LOOK_OUT_RAD.tolist()),
        over_m=OVER_M if leads_over(spec) else None,
    )
