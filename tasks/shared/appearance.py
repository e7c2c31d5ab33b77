"""The look of a scenario: light, colours, texture and eye-to-hand pose, written into the model.

Every reset first restores what the model was compiled with, so nothing of an earlier scenario
remains.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
from dm_control import mjcf
from scipy.ndimage import zoom
from scipy.spatial.transform import Rotation

from hvs_suite.cell.arena import Cell
from hvs_suite.cell.surface import TEXTURE_SIDE_PX
from hvs_suite.tasks.shared.scenario import Scenario

FloatArray = npt.NDArray[np.float64]

# Noise of three scales: stains, blotches, grain.
_TEXTURE_OCTAVES = ((4, 0.5), (16, 0.3), (64, 0.2))
_TEXTURE_DEPTH = 110.0


class Appearance:
    """Writes the look of scenarios into one compiled model.

    Args:
        physics: The compiled cell.
        cell: Its description.
    """

    def __init__(self, physics: mjcf.Physics, cell: Cell) -> None:
        model = physics.model.ptr
        self.changed_textures: tuple[int, ...] = ()
        self._painted = False
        self._eth = int(physics.bind(cell.eth).element_id)
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
        model = physics.model.ptr
        for name, value in self._defaults.items():
            getattr(model, name)[:] = value
        diffuse, ambient = scenario.light_level
        model.light_diffuse[self._light] *= diffuse
        model.vis.headlight.ambient[:] = self._ambient * ambient
        if scenario.light_direction is not None:
            model.light_dir[self._light] = scenario.light_direction
        if scenario.surface_rgb is not None:
            model.mat_rgba[self._surface, :3] = scenario.surface_rgb
        if scenario.target_rgb is not None:
            model.mat_rgba[self._targets, :3] = scenario.target_rgb
        self._tint_robot(model, scenario.robot_tint)
        model.cam_pos[self._eth] += scenario.eth_shift
        turn = Rotation.from_rotvec(scenario.eth_turn)
        nominal = Rotation.from_quat(model.cam_quat[self._eth], scalar_first=True)
        model.cam_quat[self._eth] = (turn * nominal).as_quat(scalar_first=True)
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
            else surface_texture(seed)
        )
        channels = int(model.tex_nchannel[self._texture])
        data = np.repeat(picture[..., None], channels, axis=2).ravel()
        model.tex_data[start : start + data.size] = data
        self._painted = seed is not None
        self.changed_textures = (self._texture,)


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
