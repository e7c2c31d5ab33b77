"""dm_control's physics, with correct pictures even if other renderers are in the process."""

from typing import Any

import mujoco
from dm_control import mjcf

from hvs_suite.cell import gl


class Physics(mjcf.Physics):
    """A physics that others draw as well: our renderer, ``mujoco.Renderer``, other environments."""

    @property
    def contexts(self) -> Any:
        """dm_control's renderer; a caller is about to draw, or to free it."""
        # mujoco.Renderer makes its own context current, and none when it closes, without notice.
        gl.strike_dm_control_off()
        return super().contexts

    def upload_texture(self, texture: int) -> None:
        """Have dm_control's pictures, if there were any, show a changed texture of the model.

        Args:
            texture: Its id.
        """
        if not self._contexts:
            return
        contexts = self.contexts
        with contexts.gl.make_current() as call:
            call.call(mujoco.mjr_uploadTexture, self.model.ptr, contexts.mujoco.ptr, texture)
