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
    # OpenBLAS has kernels for each generation of processors, which round differently, so a fit may
    # end elsewhere: results of servo on surface differed on another machine. These kernels run on
    # every processor with AVX2. NumPy reads the variable when it loads. A value that the user has
    # set stays.
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")
if "OMP_WAIT_POLICY" not in os.environ:
    # Two threads of torch wait for each other by spinning, on cores that other programs use. Beside
    # another training, one that spins for less long is four times as fast; alone it is as fast
    # (docs/experiments/busy-machine.md). GNU's OpenMP reads this when it loads.
    os.environ.setdefault("GOMP_SPINCOUNT", "20000")

from hvs_suite.gym import register
from hvs_suite.registry import TASKS, load

__version__ = "0.1.0"
__all__ = ["TASKS", "load"]

# Gymnasium looks names up among those registered, and imports nothing by itself.
register()
