"""One kept OpenGL context, scene and set of buffers for all pictures of a model.

dm_control's stock camera observable builds a new scene for every frame, and ``Physics.render``
changes contexts; together they cost several times what drawing the picture does. A ``Renderer``
keeps everything and hands out copies.
"""

import functools
import math
import weakref
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from hvs_suite.cell import gl
from hvs_suite.errors import RenderError

FloatArray = npt.NDArray[np.float64]

# Collision capsules live in group 3 and are never drawn.
_HIDDEN_GROUP = 3
# The graphics library rounds to single precision.
_SLACK_M = 1e-3
_MAX_GEOMS = 256


class Renderer:
    """Draws one model offscreen; made when the first picture is asked for.

    The eye in the hand sees a few of the arm's shells. The others are not sent to the graphics
    library, which would work on every corner before it finds that nothing shows.

    Args:
        model: Compiled model; its textures and meshes are uploaded once.
        max_side: Side of the largest picture that will be asked for (px).
        multisampling: Samples per pixel, 0 for none.
        studio: Shadows and reflections for people; observations go without (three times faster).

    Raises:
        RenderError: No OpenGL backend works on this machine.
    """

    def __init__(
        self, model: mujoco.MjModel, max_side: int, multisampling: int, *, studio: bool = False
    ) -> None:
        self._model = model
        self._max_side = max_side
        self._gl = gl.create_context(max_side, max_side)
        self._context = offscreen_context(
            model, max_side, multisampling, shadow_size=4096 if studio else 0
        )
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        self._scene = mujoco.MjvScene(model, _MAX_GEOMS)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = studio
        self._option = mujoco.MjvOption()
        self._option.geomgroup[_HIDDEN_GROUP] = 0
        self._option.sitegroup[:] = 0
        self._draws_all = studio
        # Around its centre, how far a geom reaches; MuJoCo has 0 for planes, which may be endless.
        radius = model.geom_rbound
        self._radius = np.where(radius > 0.0, radius + _SLACK_M, np.inf)
        self._perturbation = mujoco.MjvPerturb()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        self._buffers: dict[tuple[int, int, str], npt.NDArray[Any]] = {}
        self._free = weakref.finalize(self, _free, self._gl, self._context)
        self._free.atexit = False
        gl.free_at_exit(self._free)

    def colour(
        self, data: mujoco.MjData, camera: int | mujoco.MjvCamera, height: int, width: int
    ) -> npt.NDArray[np.uint8]:
        """Draw a camera's picture.

        Args:
            data: State to draw; poses must be up to date (``mj_step1`` or ``mj_forward``).
            camera: Camera id in the model, or a free camera.
            height: Rows of the picture (px).
            width: Columns of the picture (px).

        Returns:
            RGB picture, uint8 (H, W, 3), row 0 on top; the caller owns it.

        Raises:
            RenderError: The picture is larger than the renderer, or the renderer was closed.
        """
        rect = self._draw(data, camera, height, width)
        buffer = self._buffer(height, width, "colour")
        mujoco.mjr_readPixels(buffer, None, rect, self._context)
        return buffer[::-1].copy()

    def depth(
        self, data: mujoco.MjData, camera: int | mujoco.MjvCamera, height: int, width: int
    ) -> npt.NDArray[np.float32]:
        """Measure the distance along the optical axis.

        Takes the arguments of ``colour``.

        Returns:
            Depth in metres, float32 (H, W, 1), capped at the far plane.
        """
        rect = self._draw(data, camera, height, width)
        buffer = self._buffer(height, width, "depth")
        mujoco.mjr_readPixels(None, buffer, rect, self._context)
        extent = self._model.stat.extent
        near = self._model.vis.map.znear * extent
        far = self._model.vis.map.zfar * extent
        # With the far plane at 0 the stored value is near / (far - near) * (far / z - 1).
        metres = near * far / (near + buffer * (far - near))
        return np.ascontiguousarray(metres[::-1, :, None], dtype=np.float32)

    def segmentation(
        self, data: mujoco.MjData, camera: int, height: int, width: int
    ) -> npt.NDArray[np.int32]:
        """Tell which geom each pixel shows.

        Takes the arguments of ``colour``; multisampling must be off, or ids are blended.

        Returns:
            Geom ids, int32 (H, W), -1 where there is none.
        """
        flags = self._scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = True
        flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        try:
            picture = self.colour(data, camera, height, width).astype(np.int32)
        finally:
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = False
            flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False
        ids = picture[..., 0] + (picture[..., 1] << 8) + (picture[..., 2] << 16)
        lookup = np.full(_MAX_GEOMS + 1, -1, np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid != -1 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM.value:
                lookup[geom.segid + 1] = geom.objid
        return lookup[ids]

    def upload_texture(self, texture: int) -> None:
        """Send a changed texture of the model to the graphics library."""
        self._make_current()
        mujoco.mjr_uploadTexture(self._model, self._context, texture)

    def close(self) -> None:
        """Free the context; calling it again does nothing."""
        self._free()

    def _draw(
        self, data: mujoco.MjData, camera: int | mujoco.MjvCamera, height: int, width: int
    ) -> mujoco.MjrRect:
        if max(width, height) > self._max_side:
            raise RenderError(
                f"a picture of {width} x {height} px is larger than the {self._max_side} px that "
                "this renderer was made for"
            )
        self._make_current()
        groups = self._model.geom_group
        compiled = groups.copy()
        if isinstance(camera, int):
            # A camera that nothing carries sees most of the cell. What casts a shadow may be out of
            # view itself.
            if self._model.cam_bodyid[camera] and not self._draws_all:
                groups[self._out_of_view(data, camera, width / height)] = _HIDDEN_GROUP
            self._camera.fixedcamid = camera
            camera = self._camera
        try:
            mujoco.mjv_updateScene(
                self._model,
                data,
                self._option,
                self._perturbation,
                camera,
                mujoco.mjtCatBit.mjCAT_ALL.value,
                self._scene,
            )
        finally:
            groups[:] = compiled
        rect = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(rect, self._scene, self._context)
        return rect

    def _out_of_view(self, data: mujoco.MjData, camera: int, aspect: float) -> npt.NDArray[np.bool]:
        """Which geoms lie wholly beside what a camera sees, or behind it, (n,)."""
        axes = data.cam_xmat[camera].reshape(3, 3)
        normals = axes @ _sides(self._model.cam_fovy[camera].item(), aspect)
        distance = (data.geom_xpos - data.cam_xpos[camera]) @ normals
        return distance.max(axis=1) > self._radius

    def _make_current(self) -> None:
        if not self._free.alive:
            raise RenderError("the renderer was closed; make a new environment")
        # Other environments in this process may have made theirs current since.
        self._gl.make_current()

    def _buffer(self, height: int, width: int, kind: str) -> npt.NDArray[Any]:
        key = (height, width, kind)
        if key not in self._buffers:
            self._buffers[key] = (
                np.empty((height, width, 3), np.uint8)
                if kind == "colour"
                else np.empty((height, width), np.float32)
            )
        return self._buffers[key]


def offscreen_context(
    model: mujoco.MjModel, max_side: int, multisampling: int, *, shadow_size: int
) -> mujoco.MjrContext:
    """Upload a model into the current OpenGL context, with a frame buffer to draw it into.

    Args:
        model: Compiled model; comes back as it was.
        max_side: Side of the frame buffer (px).
        multisampling: Samples per pixel, 0 for none.
        shadow_size: Side of the shadow map (px), 0 for no shadows.

    Returns:
        MuJoCo's context, which draws into the frame buffer.

    Raises:
        RenderError: The graphics library lacks what MuJoCo needs.
    """
    size, quality = model.vis.global_, model.vis.quality
    kept = size.offwidth, size.offheight, quality.offsamples, quality.shadowsize
    # MjrContext reads these from the model only when it is made. Other renderers of the model
    # (dm_control, mujoco.Renderer) must find the sizes that it was compiled with.
    try:
        size.offwidth = size.offheight = max_side
        quality.offsamples, quality.shadowsize = multisampling, shadow_size
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    except mujoco.FatalError as error:
        raise RenderError(f"MuJoCo could not set up OpenGL: {error}") from error
    finally:
        size.offwidth, size.offheight, quality.offsamples, quality.shadowsize = kept
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
    return context


@functools.cache
def _sides(fov_deg: float, aspect: float) -> FloatArray:
    """The planes through a camera around what it sees.

    Args:
        fov_deg: Its field of view, from bottom to top (deg).
        aspect: Width of the picture by its height.

    Returns:
        Unit normals of its four sides, outward, and backward, in MuJoCo's camera frame, (3, 5).
    """
    slope = math.tan(0.5 * math.radians(fov_deg))
    across = aspect * slope
    normals = np.array(
        [[1, 0, across], [-1, 0, across], [0, 1, slope], [0, -1, slope], [0, 0, 1]], np.float64
    ).T
    return normals / np.linalg.norm(normals, axis=0)


def _free(context: gl.GLContext, mujoco_context: mujoco.MjrContext) -> None:
    context.make_current()
    mujoco_context.free()
    context.free()
