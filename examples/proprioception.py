"""From sensors in a body to bones: record with markers once, learn, then live without them; another day,
corrected by a few frames.

python examples/proprioception.py
"""

from __future__ import annotations

import numpy as np

import femsense as fs

rng = np.random.default_rng(1)


# %% A finger that bends: two light sensors, four markers along its back (a camera would give them)
def record(seconds: float, base_m: tuple[float, float, float] = (0.0, 0.0, 0.0)):
    """Return readings with markers of a finger that bends to and fro."""
    time = np.arange(0.0, seconds, 1 / 30)
    bend = 1.2 * np.sin(0.9 * time) * np.sin(0.23 * time)  # at the tip [rad]; straight at first
    s = np.array([0.02, 0.04, 0.06, 0.08])
    angle = bend[:, None] * s / s[-1] + 1e-9
    markers = np.stack([s * (1 - np.cos(angle)) / angle, 0 * angle, s * np.sin(angle) / angle], axis=2)
    light = np.stack([np.exp(-bend), 1 / (1 + np.exp(-2 * bend))], axis=1) + 0.005 * rng.normal(size=(len(time), 2))
    seen = markers + 1e-4 * rng.normal(size=markers.shape) + base_m
    return fs.labelled(time, light, seen, channels=("outer", "inner"))


# %% Learn: which map, and how well it predicts blocks of time that it never saw
bones = fs.ArmatureOptions(bones=6, plane_normal=(0, 1, 0))
model = fs.learn(record(60.0), options=fs.LearnOptions(kinds=("ridge", "radial", "network"), memories=((),), bones=bones))

# %% Live: a row of readings becomes markers and bones, and says when it is outside what was learnt
live = model.live()
pose = live.step([1.4, 0.35], time_s=0.0)
strange = live.step([1.4, 0.95], time_s=0.03)

# %% Another day: the base was moved; ten labelled frames put it right
today = record(20.0, base_m=(0.005, 0.0, -0.002))
found = fs.drift(model, today)
mended = fs.adapt(model, today.select(np.arange(0, len(today), len(today) // 10)))

if __name__ == "__main__":
    print(model)
    for bone, place in zip(model.bone_names, pose.bones.positions):
        print(f"  {bone}  {1e3 * place[0]:6.2f} {1e3 * place[2]:6.2f} mm")
    print(*(outside.text for outside in strange.outside), sep="\n")
    print(found.text)
    print(f"corrected by {mended.report['adapted']['by']}: {mended.report['adapted']['error_mm']:.2f} mm")
