"""hvs_suite: the benchmark suite for hybrid visual servoing with a KUKA LBR iiwa 7.

    import hvs_suite

    env = hvs_suite.load("align-thesis", split="train")
    time_step = env.reset(scenario=0)

``hvs_suite.TASKS`` maps every task name to its parameters; ``gymnasium.make`` finds the same tasks
as ``hvs_suite/<name>-v<version>``.
"""

import os
import platform

if platform.machine() in ("x86_64", "AMD64"):
    # OpenBLAS has kernels for each generation of processors, which round differently, and a fit
    # that ends there ends elsewhere: results of servo on surface came out otherwise on another
    # machine. These run wherever AVX2 does. NumPy asks when it loads; who has set it knows why.
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")

from hvs_suite.gym import register
from hvs_suite.registry import TASKS, load

__version__ = "0.1.0"
__all__ = ["TASKS", "load"]

# Gymnasium looks names up among those registered, and imports nothing by itself.
register()
