# %% [markdown]
# # From an STL file to the first force
#
# You have a surface of your robot and a depth camera. This tutorial goes from the STL file to a force with its interval. Where you would record, the virtual rig
# records: a beam of silicone, pulled by one cable and pressed by a ball. It takes about a minute.
#
# The tutorial is a script, `docs/tutorials/first_force.py`: run it as it is, or open it as a notebook with Jupytext.

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
# ## The surface
#
# A beam of 100 × 18 × 18 mm stands in for your STL file.

# %%
import trimesh

beam = trimesh.creation.box(extents=[100, 18, 18])
beam.apply_translation([50, 0, 0])
beam.export("beam.stl")

# %% [markdown]
# ## From the surface to a robot
#
# An STL file has no unit, so you state it. `--size` is the edge length of the tetrahedra; without it femsense chooses one. fTetWild, which fills the surface,
# is randomised: your mesh, and the figures below, differ slightly.

# %%
shell("femsense mesh beam.stl --unit mm --size 9 -o beam")

# %% [markdown]
# The new `robot.toml` marks what is guessed: material, gravity and clamp. Put in what you know. Here the base (x = 0) is clamped, the silicone has a
# modulus of 250 kPa, and one cable runs below the upper face.

# %%
file = Path("beam/robot.toml")
text = file.read_text()
text = text[: text.index("# GUESSED: a soft silicone")]
text += """
[mesh]
file = "mesh.vtu"
unit = "mm"
element = "tet10"

[material]
young_modulus_pa = 250e3
poisson_ratio = 0.45
density_kg_m3 = 1070.0

[gravity]
vector_m_s2 = [0.0, 0.0, -9.81]

[[fixed]]
box_m = [[-0.001, -0.01, -0.01], [0.001, 0.01, 0.01]]

[[cables]]
name = "top"
path_m = [[0.095, 0, 0.006], [0.075, 0, 0.006], [0.055, 0, 0.006], [0.035, 0, 0.006], [0.015, 0, 0.006]]
pull_point_m = [-0.005, 0.0, 0.006]

[appearance]
color_rgb = [0.2, 0.5, 0.8]
"""
places = {"a": (30, -9, 4), "b": (50, -9, -4), "c": (70, -9, 4), "d": (95, -9, -4), "e": (60, 0, 9)}
for name, place in places.items():
    text += f'\n[[markers]]\nname = "{name}"\nposition_m = {[x / 1000 for x in place]}\n'
file.write_text(text)

shell("femsense inspect beam")

# %% [markdown]
# ## A recording
#
# With a camera you would use `femsense import` ([any camera](../guides/any-camera.md)). The rig needs a script: the cable is pulled up to 3 N without contact, then a ball presses near the
# tip with 0.3 N. The rig computes with half the element size of the estimator, and its camera has the noise of a stereo camera.

# %%
Path("bench.toml").write_text("""format = "femsense-script-1"
seed = 4

[[sweeps]]
label = "pull"
cables = { top = 3.0 }
rest = 2
up = 4
down = 3

[[sweeps]]
label = "press"
cables = { top = 2.0 }
hold = 1
up = 2
down = 1

[[contacts]]
sweep = "press"
point_m = [0.080, 0.0, 0.009]
force_n = 0.3

[camera]
width = 424
height = 240
fx = 500.0
eye_m = [0.05, -0.22, 0.16]
target_m = [0.05, 0.0, -0.005]

[camera.noise]
subpixel_px = 0.05
baseline_m = 0.055

[markers]
std_m = 0.2e-3

[clouds]
kind = "ply"

[scene]
floor_z_m = -0.08
robot_rgb = [0.2, 0.5, 0.8]
""")
shell("femsense simulate beam bench.toml -o recording")

# %% [markdown]
# `inspect` checks that recording and robot belong together, and states which forces this camera resolves. A force of 0.3 N near the tip is far above three σ.

# %%
shell("femsense inspect recording --robot beam")

# %% [markdown]
# ## Calibrate and estimate
#
# Nothing says where the camera stands. `calibrate` finds its pose from the contact-free frames; `estimate` then finds contacts and forces.

# %%
shell("femsense calibrate beam recording -o calibration.json")

# %%
shell("femsense estimate beam recording -c calibration.json -o run")

# %% [markdown]
# ## The force
#
# The run is a folder of tables, and the rig knows the truth.

# %%
run = fs.read_run(Path("run"))
truth = np.genfromtxt("recording/truth/contacts.csv", delimiter=",", names=True)
for contact in run.contacts:
    [true] = truth[truth["frame"] == contact.frame]["force_n"]
    print(
        f"frame {contact.frame}: {contact.force_n:.3f} ± {1.96 * contact.std_n:.3f} N (95 %), true {true:.3f} N, {contact.source}"
    )

# %%
figure = fs.plot_run(run)
figure.savefig("first-force.png", dpi=110)

# %% [markdown]
# Next: [Is this force real?](../guides/is-this-force-real.md), or `femsense view run` to see it move.
