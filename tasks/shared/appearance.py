"""The look of a scenario: light, colours, texture and eye-to-hand pose, written into the model.

Every reset first restores what the model was compiled with, so nothing of an earlier scenario
remains.
"""

import colorsys
from typing import Any

import numpy as np
import numpy.typing as npt
from dm_control import mjcf
from scipy.ndimage import zoom
from scipy.spatial.transform import Rotation

from hvs_suite.cell.arena import Cell
from hvs_suite.cell.surface import TEXTURE_SIDE_PX
from hvs_suite.tasks.shared.scenario import Scenario, towards
from hvs_suite.tasks.shared.spec import Disturbances

FloatArray = npt.NDArray[np.float64]

# Noise of three scales: stains, blotches, grain.
_TEXTURE_OCTAVES = ((4, 0.5), (16, 0.3), (64, 0.2))
_TEXTURE_DEPTH = 110.0


class Appearance:
    """Writes the look of scenarios into one compiled model.

    Args:
        physics: The compiled cell.
        cell: Its description.
        spec: How far scenarios change the look.
    """

    def __init__(self, physics: mjcf.Physics, cell: Cell, spec: Disturbances) -> None:
        model = physics.model.ptr
        self._spec = spec
        self.changed_textures: tuple[int, ...] = ()
        self._painted = False
        self._eth = int(physics.bind(cell.eth).element_id)
        self._eih = int(physics.bind(cell.eih).element_id)
        self._light = int(physics.bind(cell.light).element_id)
        self._surface = int(physics.bind(cell.surface.material).element_id)
        self._targets = [int(physics.bind(marker.material).element_id) for marker in cell.markers]
        self._shells = np.array(physics.bind(cell.robot.shell_geoms).element_id, int).ravel()
        self._texture = int(physics.bind(cell.surface.texture).element_id)
        self._defaults: dict[str, npt.NDArray[Any]] = {
            name: np.array(getattr(model, name))
            for name in (
                "cam_pos",
                "cam_quat",
                "light_dir",
                "light_diffuse",
                "mat_rgba",
            )
        }
        self._ambient = np.array(model.vis.headlight.ambient)

    def apply(self, physics: mjcf.Physics, scenario: Scenario) -> None:
        """Write the look of a scenario."""
        model, spec = physics.model.ptr, self._spec
        for name, value in self._defaults.items():
            getattr(model, name)[:] = value
        diffuse, ambient = towards(np.ones(2), scenario.light_level, spec.light_strength)
        model.light_diffuse[self._light] *= diffuse
        model.vis.headlight.ambient[:] = self._ambient * ambient
        if scenario.light_direction is not None:
            own = model.light_dir[self._light].copy()
            direction = towards(own, scenario.light_direction, spec.light_strength)
            model.light_dir[self._light] = direction
        for materials, rgb in (
            ([self._surface], scenario.surface_rgb),
            (self._targets, scenario.target_rgb),
        ):
            if rgb is not None:
                rgb_there = towards(model.mat_rgba[materials, :3], rgb, spec.colour_strength)
                model.mat_rgba[materials, :3] = np.clip(rgb_there, 0.0, 1.0)
        if spec.target_hue_deg:
            for material in self._targets:
                own = model.mat_rgba[material, :3]
                model.mat_rgba[material, :3] = _turned(own, spec.target_hue_deg)
        self._tint_robot(model, towards(np.ones(3), scenario.robot_tint, spec.colour_strength))
        _displace(model, self._eth, scenario.eth_shift, scenario.eth_turn)
        if scenario.eih_shift is not None and scenario.eih_turn is not None:
            _displace(model, self._eih, scenario.eih_shift, scenario.eih_turn)
        self._paint(model, scenario.texture_seed)

    def _tint_robot(self, model: Any, tint: FloatArray) -> None:
        # A geom's own colour hides its material's, so only the materials are tinted.
        materials = np.unique(model.geom_matid[self._shells])
        model.mat_rgba[materials, :3] = np.clip(model.mat_rgba[materials, :3] * tint, 0.0, 1.0)

    def _paint(self, model: Any, seed: int | None) -> None:
        if seed is None and not self._painted:
            self.changed_textures = ()
            return
        start = int(model.tex_adr[self._texture])
        picture = (
            np.full((TEXTURE_SIDE_PX, TEXTURE_SIDE_PX), 255, np.uint8)
            if seed is None
            else _weakened(surface_texture(seed), self._spec.texture_strength)
        )
        channels = int(model.tex_nchannel[self._texture])
        data = np.repeat(picture[..., None], channels, axis=2).ravel()
        model.tex_data[start : start + data.size] = data
        self._painted = seed is not None
        self.changed_textures = (self._texture,)


def _displace(model: Any, camera: int, shift: FloatArray, turn: FloatArray) -> None:
    """Move and turn a camera in the frame of its body: (3,) m, and a rotation vector (3,) rad."""
    model.cam_pos[camera] += shift
    nominal = Rotation.from_quat(model.cam_quat[camera], scalar_first=True)
    turned = Rotation.from_rotvec(turn) * nominal
    model.cam_quat[camera] = turned.as_quat(scalar_first=True)


def _turned(rgb: FloatArray, hue_deg: float) -> tuple[float, float, float]:
    """A colour with its hue turned."""
    hue, saturation, value = colorsys.rgb_to_hsv(*rgb.tolist())
    return colorsys.hsv_to_rgb((hue + hue_deg / 360.0) % 1.0, saturation, value)


def _weakened(texture: npt.NDArray[np.uint8], strength: float) -> npt.NDArray[np.uint8]:
    """A texture as deep as the strength says; 1 leaves it as it is."""
    white = np.full(texture.shape, 255.0)
    return np.clip(towards(white, texture.astype(np.float64), strength), 0, 255).astype(np.uint8)


def surface_texture(seed: int) -> npt.NDArray[np.uint8]:
    """Grey value noise of three scales.

    Args:
        seed: Key of the picture.

    Returns:
        uint8 (128, 128), 145 to 255.
    """
    random = np.random.Generator(np.random.Philox(key=seed))
    height = np.zeros((TEXTURE_SIDE_PX, TEXTURE_SIDE_PX))
    for cells, weight in _TEXTURE_OCTAVES:
        coarse = random.random((cells, cells))
        height += weight * zoom(
            coarse, TEXTURE_SIDE_PX / cells, order=1, grid_mode=True, mode="grid-wrap"
        )
    return (255.0 - _TEXTURE_DEPTH * np.clip(height, 0.0, 1.0)).astype(np.uint8)
