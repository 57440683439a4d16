# %% [markdown]
# # From sensors to a headset
#
# A soft robot often works where no camera sees it. Then sensors in its body have to tell its shape. You record sensors and markers together once, `femsense learn`
# fits a map from sensors to markers and bones, and `femsense stream` sends the bones to a browser or a headset. Here the virtual rig plays the robot: the finger of the package,
# with one strain sensor along its back.

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
# ## Record once with markers
#
# `[[sensors]]` of a script writes `sensors.csv` next to the markers. On your robot, both come from your logger ([the two files](../guides/proprioception.md#two-files)).

# %%
Path("script.toml").write_text("""format = "femsense-script-1"
dt_s = 0.1

[[sweeps]]
label = "far"
cables = { flexor = 1.5 }
rest = 1
up = 30
down = 30

[[sweeps]]
label = "near"
cables = { flexor = 0.7 }
up = 30
down = 30

[[sweeps]]
label = "between"
cables = { flexor = 1.1 }
up = 30
down = 30

[[sensors]]
name = "back"
from_m = [0.010, 0.0, 0.001]
to_m = [0.050, 0.0, 0.001]
noise_std = 1e-4

[camera]
eye_m = [0.05, -0.25, 0.10]
target_m = [0.05, 0.0, 0.0]

[markers]
names = ["rib-1", "rib-2", "rib-3", "tip"]
occlusion = false

[truth]
refinements = 0
""")
shell("femsense simulate finger script.toml -o rig")

# %% [markdown]
# The markers are in the frame of the camera. A calibration brings them, and later the bones, into the frame of the robot.

# %%
shell("femsense calibrate finger rig -o calibration.json")

# %% [markdown]
# ## Learn
#
# `learn` compares four maps, from a linear one to a committee of networks. A less simple map has to be 5 % better on blocks of time that were held out.

# %%
shell("femsense learn rig/sensors.csv rig/markers.csv -c calibration.json -o finger.onnx")

# %% [markdown]
# ## Use the model
#
# One reading gives markers and bones, and the model says when a reading lies outside what it has learned.

# %%
model = fs.load_model(Path("finger.onnx"))
table = np.genfromtxt("rig/sensors.csv", delimiter=",", names=True)
reading = [float(table["back"][30])]
bones = model.armature(reading)
print("markers [mm]:", (1e3 * model.markers(reading)).round(1).tolist())
print("95 % radius [mm]:", (1e3 * np.asarray(model.interval(reading))).round(2).tolist())
print(f"{len(bones.positions)} bones, tip at {(1e3 * bones.positions[-1]).round(1)} mm")
for outside in model.check([10.0]):
    print(outside.text)

# %% [markdown]
# ## To a browser and a headset
#
# `stream` reads the sensors and serves a page with the moving bones. It runs until Ctrl-C, so this page does not run it:
#
# ```sh
# femsense stream --sensors rig/sensors.csv --model finger.onnx --browser   # replays the file; serial:, udp://, mqtt:// and ws:// read live
# ```
#
# The command prints an address. Open it on the headset in the same network, and choose *Enter VR*. [Headsets](../guides/headsets.md) covers HoloLens 2, Quest, iPhone and Unity;
# [Streams](../guides/streaming.md) lists topics and bytes, and who may watch.
