"""The robot cell: the iiwa 7, its two cameras, work surface and markers."""

from hvs_suite.cell.gl import choose_backend

# MuJoCo and dm_control read MUJOCO_GL while they are imported, so this comes before either.
choose_backend()
