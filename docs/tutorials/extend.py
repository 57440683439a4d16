# %% [markdown]
# # An effect, an importer, a camera of your own
#
# Three extensions, each in one file.

# %% tags=["setup"]
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np

import femsense as fs


def shell(command: str) -> None:
    """Run a femsense command as a terminal would, and show what it prints."""
    words = shlex.split(command)
    done = subprocess.run(
        [sys.executable, "-m", *words], text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False
    )
    print(done.stdout.strip("\n"), flush=True)
    if done.returncode:
        raise SystemExit(f"{command}: exit status {done.returncode}")


# %% [markdown]
# ## An effect
#
# `femsense improve` looks for what the model lacks in a list of effects. Your own effect takes a name, a table of parameters and a function. This one is a magnet next to the tip of the beam:
# it pulls with a constant force, whose three components are fitted. Where the magnet sits is tried from two seeds.

# %%
Path("magnet.py").write_text('''"""A magnet next to the robot."""

import numpy as np

name = "magnet"
parameters = {"force_n": {"unit": "N", "low": -0.5, "high": 0.5, "size": 3}}
seeds = [{"center_m": [0.1, 0.0, 0.0]}, {"center_m": [0.05, 0.0, 0.0]}]


def forces(nodes_m, force_n, center_m):
    """Nodal forces [N], (n, 3), at the nodes of the mesh at rest [m], (n, 3)."""
    weight = np.exp(-(((nodes_m - center_m) / 0.02) ** 2).sum(axis=1))
    return np.outer(weight / weight.sum(), force_n)
''')

# %% [markdown]
# An improved robot would name the file in its `[[effects]]`. You can write such an entry yourself, and each command then computes with the magnet:

# %%
robot = fs.load_robot("finger")
fs.save_robot(robot, Path("finger-magnet"))
with Path("finger-magnet/robot.toml").open("a") as stream:
    stream.write("""
[[effects]]
name = "magnet"
file = "magnet.py"
center_m = [0.1, 0.0, 0.0]
force_n = [0.0, 0.0, 0.05]
""")
Path("finger-magnet/magnet.py").write_text(Path("magnet.py").read_text())

with_magnet = fs.load_robot("finger-magnet")
states = [fs.solve_equilibrium(each.body).positions for each in (robot, with_magnet)]
moved = np.linalg.norm(states[1] - states[0], axis=1).max()
print(f"0.05 N of the magnet move the finger by up to {1e3 * moved:.1f} mm")

# %% [markdown]
# To let the loop search for it:
#
# ```sh
# femsense improve my-robot my-recording --user-effect magnet.py -o improved
# ```
#
# [An effect of your own](../effects/own.md) lists the other functions: `change` for another robot, `correct` for markers.
#
# ## An importer
#
# A format that `femsense import` does not read takes one call, if you can load it as arrays. Suppose that your logger writes an `.npz` with times, one cable tension and three markers:

# %%
rng = np.random.default_rng(0)
names = ("rib-1", "rib-2", "tip")
rest = np.array([fs.load_robot("finger").markers.positions(states[0])[robot.marker_names.index(name)] for name in names])
np.savez("log.npz", t=np.arange(5) / 10, tendon=np.linspace(0, 1, 5), xyz=rest + 1e-4 * rng.normal(size=(5, 3, 3)))


def load_log(path: Path) -> fs.Recording:
    """Return the recording of a log."""
    log = np.load(path)
    return fs.recording_from_arrays(
        log["t"],
        inputs={"flexor": log["tendon"]},
        actuation="tension",
        markers={name: log["xyz"][:, i] for i, name in enumerate(names)},
        free=np.ones(len(log["t"]), dtype=bool),
    )


recording = load_log(Path("log.npz"))
fs.save_recording(recording, Path("from-log"))
shell("femsense inspect from-log")

# %% [markdown]
# Clouds and depth images join by their files: `fs.make_recording` takes `Views` with a file for each frame and camera ([reference](../reference/recordings.md)). To make the format one that
# `femsense import` recognises, add a `Format` to the registry, `femsense/io/importers/formats.py` ([contributing](../appendix/contributing.md)).
#
# ## A camera
#
# `femsense live` needs frames from your camera. Without any code of femsense: let your driver write numbered files into a folder, and pass the folder as the camera.
#
# ```text
# my-camera/camera.toml        # a table [camera], as in recording.toml
# my-camera/depth/000000.png   # 16 bits
# my-camera/color/000000.png   # registered to depth
# ```
#
# ```sh
# femsense live my-robot --camera my-camera --actuation fixed:top=2
# ```
#
# Write each file under another name and rename it, so that no half-written image is read. This is the table:

# %%
Path("my-camera/depth").mkdir(parents=True)
Path("my-camera/camera.toml").write_text("""[camera]
width = 640
height = 400
fx = 450.0
fy = 450.0
cx = 320.0
cy = 200.0
depth_unit_m = 0.001
""")

# %% [markdown]
# A source inside femsense is a class with four methods, `open`, `newest`, `close` and `list_devices` (`femsense/live/sources/source.py` defines them and their errors), and a line in
# `SOURCES` of `femsense/live/sources/__init__.py`. It runs in a process of its own, so a driver that hangs can be ended. `software:RECORDING?unplug=90+5` is a source that misbehaves on
# purpose: your class should pass the same tests.
