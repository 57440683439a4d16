"""A magnet beside the robot: an effect of one's own for `femsense improve … --user-effect examples/magnet.py`.

It pulls with a force that falls off with the distance from the place where it sits.
"""

import numpy as np

name = "magnet"
lacks = "a magnet beside the tip"
parameters = {"force_n": {"unit": "N", "low": -0.5, "high": 0.5, "size": 3}}
seeds = [{"center_m": [0.1, 0.0, 0.0]}, {"center_m": [0.05, 0.0, 0.0]}]  # tried, not fitted


def forces(nodes_m, force_n, center_m):
    weight = np.exp(-(((nodes_m - center_m) / 0.02) ** 2).sum(axis=1))
    return np.outer(weight / weight.sum(), force_n)
