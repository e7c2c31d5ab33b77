"""Render one small picture with the backend in ``MUJOCO_GL`` and say which driver drew it.

Run as ``python -m hvs_suite.cli.probe_gl`` in a process of its own: a broken driver may crash it,
and a process keeps the first backend it has loaded. Prints one JSON object: ``renderer``, the
driver's name, and ``colours``, the number of different colours in the picture.
"""

import json

SCENE = """
<mujoco>
  <worldbody>
    <light pos="0 0 2"/>
    <geom type="sphere" size="0.3" rgba="1 0.4 0 1"/>
    <camera name="view" pos="0 -1 0" euler="90 0 0"/>
  </worldbody>
</mujoco>
"""


def main() -> None:
    """Render, look at the pixels, print what was found."""
    import mujoco
    import numpy as np
    from OpenGL import GL

    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 64, 64) as renderer:
        renderer.update_scene(data, "view")
        picture = renderer.render()
        name = GL.glGetString(GL.GL_RENDERER)
    colours = len(np.unique(picture.reshape(-1, 3), axis=0))
    print(json.dumps({"renderer": name.decode() if name else "unknown", "colours": colours}))


if __name__ == "__main__":
    main()
