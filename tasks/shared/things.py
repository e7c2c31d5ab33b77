"""Flat things that lie around: discs of several colours, one of which is meant, and what distracts.

What is meant is the one whole disc of its colour; everything else differs from it in colour or in
outline, and keeps a distance.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.placing import RingSpec
from hvs_suite.tasks.shared.props import Placed
from hvs_suite.tasks.shared.spec import scene

if TYPE_CHECKING:
    from hvs_suite.cell.prop import Shape

FloatArray = npt.NDArray[np.float64]

COLOURS = ("red", "blue", "green", "yellow")
"""Of the discs; the same as the cell's paints, spelled out because those load MuJoCo."""
OUTLINES: tuple[Literal["square", "ring", "half disc"], ...] = ("square", "ring", "half disc")
"""What is not the target although it has its colour."""
MARKER = "disc-red"
"""The disc that is the marker of all families."""
_PACKING = 0.3
"""Share of the ring that things may fill with the room that they keep; more is seldom found."""
_MAX_REDRAWS = 1000


@dataclasses.dataclass(frozen=True, kw_only=True)
class ThingsSpec(RingSpec):
    """Parameters of what lies around.

    Attributes:
        colours: Colours of the discs that may be meant; one of each lies there.
        n_distractors: Fewest and most things that are never meant.
        spacing_m: Least distance between the middles of things that lie on the surface (m).
    """

    colours: tuple[str, ...] = scene(("red",))
    n_distractors: tuple[int, int] = scene((0, 0))
    spacing_m: float = scene(0.10)

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence.

        Raises:
            OptionError: One of them does not.
        """
        super().__post_init__()
        for colour in self.colours:
            if colour not in COLOURS:
                raise OptionError(f"colours has {colour!r}, which is none of {', '.join(COLOURS)}")
        if not self.colours or len(set(self.colours)) < len(self.colours):
            raise OptionError(f"colours is {self.colours}; name one or several, each once")
        self._check_range("n_distractors")
        self._check_positive("spacing_m")
        inner, outer = self.ring_m
        most = int(_PACKING * (outer**2 - inner**2) / (0.5 * self.spacing_m) ** 2)
        wanted = self.n_distractors[1] + len(self.colours)
        if wanted > most:
            raise OptionError(
                f"n_distractors is {self.n_distractors}: {wanted} things do not fit on the ring, "
                f"{self.spacing_m} m apart; use at most {most - len(self.colours)}"
            )


class Things:
    """All flat things of a family.

    Args:
        spec: Which, and how many.

    Attributes:
        stickers: All of them but the marker, to be attached to the cell.
        kinds: Colour and outline of each, the marker included, by the name of its prop.
    """

    def __init__(self, spec: ThingsSpec) -> None:
        from hvs_suite.cell.prop import Sticker

        self._spec, size = spec, spec.target_diameter_m
        self.kinds = {disc_name(colour): f"{colour} disc" for colour in spec.colours}
        self.stickers: list[Sticker] = [
            Sticker(disc_name(colour), "disc", colour, size)
            for colour in spec.colours
            if disc_name(colour) != MARKER
        ]
        self._others = []
        for number, (outline, colour) in enumerate(self._distractors()):
            name = f"thing-{number}"
            self.kinds[name] = f"{colour} {outline}"
            self._others.append(name)
            self.stickers.append(Sticker(name, outline, colour, size))

    def _distractors(self) -> "list[tuple[Shape, str]]":
        """Outline and colour of everything that can be put there to distract, one prop each."""
        spec = self._spec
        if not spec.n_distractors[1]:
            return []
        kinds: list[tuple[Shape, str]] = [
            ("disc", colour) for colour in COLOURS if colour not in spec.colours
        ]
        kinds += [(outline, colour) for outline in OUTLINES for colour in spec.colours]
        # Two of each, and more where that is not enough.
        count = max(2 * len(kinds), spec.n_distractors[1])
        return [kinds[number % len(kinds)] for number in range(count)]

    def lay_out(
        self,
        random: np.random.Generator,
        draw_place: Callable[[np.random.Generator], tuple[float, float]],
        colour: str,
        target: FloatArray,
    ) -> list[Placed]:
        """Lay them out, each at a distance from all others.

        Args:
            random: Draws.
            draw_place: Draws a place (m).
            colour: Of the disc that is meant.
            target: Where that lies, (2,) m.

        Returns:
            What lies where, the disc that is meant first.

        Raises:
            OptionError: There is no room for all of them.
        """
        spec = self._spec
        things = [disc_name(each) for each in spec.colours if each != colour]
        low, high = spec.n_distractors
        count = int(random.integers(low, high + 1))
        chosen = random.permutation(len(self._others))[:count]
        things += [self._others[number] for number in chosen]
        middles = [target]
        for _ in things:
            for _ in range(_MAX_REDRAWS):
                place = np.array(draw_place(random))
                if np.linalg.norm(np.subtract(middles, place), axis=1).min() >= spec.spacing_m:
                    break
            else:
                raise OptionError(
                    f"no room for {len(things)} things, {spec.spacing_m} m apart; lower "
                    "n_distractors or spacing_m"
                )
            middles.append(place)
        yaws = random.uniform(-math.pi, math.pi, len(middles))
        return [
            Placed(name, np.array([*place, 0.0, yaw]))
            for name, place, yaw in zip([disc_name(colour), *things], middles, yaws, strict=True)
        ]


def disc_name(colour: str) -> str:
    """Name of the disc of a colour."""
    return f"disc-{colour}"
