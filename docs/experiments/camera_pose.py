"""What targets say about a camera whose pose is not exact: see camera-pose.md.

Casts a ray to each target of ``sequence-hard`` from where the eye to hand is in the scene, lays it
into where that camera is taken to be, and asks two filters where the target is. Then each is told
the place, as the eye in hand would, and goes on to the next target. No arm and no pictures.
"""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

import hvs_suite
from hvs_suite.policies.belief.cell_model import cell_model

FloatArray = npt.NDArray[np.float64]

SCENES = 300
SIGHT_RAD = 7e-4
"""Error of a ray, as the filters take it: 2 mm at the target."""
ON_TABLE = np.diag([0.3, 0.3, 1e-3]) ** 2
"""Covariance of a target before it is seen (m2)."""
ONE_OFFSET = np.diag([0.0456, 0.0456, 0.0231]) ** 2, np.diag([0.009, 0.009, 0.0125]) ** 2
"""Covariance of an offset (m2) and what is added to it from target to target, as demonstrations of
``sequence-hard`` have them."""
SHIFT_AND_TURN = np.diag([0.0088] * 3 + [np.deg2rad(0.88)] * 3) ** 2, np.zeros((6, 6))
"""The same of a shift (m2) and a turn (rad2), as the task draws them."""


def offset_of(way: FloatArray) -> FloatArray:
    """How an offset moves what is shown, (3, 3)."""
    return np.eye(3)


def pose_of(way: FloatArray) -> FloatArray:
    """How shift and turn of a camera move what it shows, (3, 6), by the way from its centre."""
    x, y, z = way
    return np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])


def main() -> None:
    """Print how far off the believed targets are, in their order (mm)."""
    with hvs_suite.load("sequence-hard", split="dev", observations="state") as env:
        cell = cell_model(env.spec)
        scenes = [env.task.source.draw(i) for i in range(SCENES)]
    centre, axes = np.array(cell.eth_origin), np.array(cell.eth_rotation)
    for name, moves, (unknown, drift) in (
        ("one offset", offset_of, ONE_OFFSET),
        ("shift and turn", pose_of, SHIFT_AND_TURN),
    ):
        errors = []
        for scene in scenes:
            off, P = np.zeros(len(unknown)), unknown
            turned = Rotation.from_rotvec(scene.eth_turn).as_matrix() @ axes
            for target in scene.targets:
                ray = axes @ turned.T @ (target - centre - scene.eth_shift)
                ray /= np.linalg.norm(ray)
                way = ray * (-centre[2] / ray[2])
                H = np.hstack([np.eye(3), moves(way)])
                # A ray says nothing of the distance.
                R = (SIGHT_RAD * np.linalg.norm(way)) ** 2 * np.eye(3) + 10.0 * np.outer(ray, ray)
                x = np.concatenate([[0.6, 0.0, 0.0], off])
                C = np.block([[ON_TABLE, np.zeros((3, len(off)))], [np.zeros((len(off), 3)), P]])
                x, C = update(x, C, H, centre + way, R)
                errors.append(np.linalg.norm(x[:2] - target[:2]))
                told = np.eye(3, len(x))
                x, C = update(x, C, told, target, 1e-8 * np.eye(3))
                off, P = x[3:], C[3:, 3:] + drift
        table = 1000.0 * np.array(errors).reshape(SCENES, -1)
        for share in (50, 90, 98):
            print(f"{name}, {share} %:", np.percentile(table, share, axis=0).round(1))


def update(
    x: FloatArray, C: FloatArray, H: FloatArray, seen: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A Kalman filter's step: mean and covariance once H x was seen with covariance R."""
    gain = C @ H.T @ np.linalg.inv(H @ C @ H.T + R)
    return x + gain @ (seen - H @ x), C - gain @ H @ C


if __name__ == "__main__":
    main()
