# %% [markdown]
# # A bag to forces in the browser
#
# A depth camera recorded a bag: RealSense `.bag` or `.db3`, or any ROS 1 or ROS 2 bag with depth images and their lens. This tutorial goes from the bag to forces in the browser. Nothing marks the
# robot, and nobody knows where the camera stands: depth and colour images suffice. It needs `pip install "femsense[ros]"`.

# %% tags=["setup"]
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

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
# ## The bag
#
# If you have a bag, skip this part. Here the virtual rig plays the robot and the camera, and a few lines write its images and tensions as a ROS 2 bag: depth and colour images, the lens, and the efforts of
# the motor as `JointState`. The probe that presses is grey: the finger is orange, and femsense separates robot and object by the colour that `robot.toml` declares (`appearance.color_rgb`).

# %%
Path("script.toml").write_text("""format = "femsense-script-1"
seed = 2
dt_s = 0.5

[[sweeps]]
label = "pull"
cables = { flexor = 1.5 }
rest = 3
up = 5
down = 4

[[sweeps]]
label = "press"
cables = { flexor = 1.0 }
hold = 1
up = 2
down = 1

[[contacts]]
sweep = "press"
point_m = [0.079, 0.0, 0.0148]
force_n = 0.3

[truth]
refinements = 0

[camera]
width = 424
height = 240
fx = 500.0
eye_m = [0.05, -0.17, 0.20]
target_m = [0.05, 0.0, 0.005]

[camera.noise]
subpixel_px = 0.05
baseline_m = 0.055

[clouds]
kind = "depth"

[scene]
floor_z_m = -0.06
probe_rgb = [0.20, 0.22, 0.25]
""")
shell("femsense simulate finger script.toml -o rig")

# %%
store = get_typestore(Stores.ROS2_HUMBLE)
message = store.types


def header(time_s: float) -> object:
    """Return a header with a stamp."""
    stamp = message["builtin_interfaces/msg/Time"](int(time_s), round(1e9 * (time_s % 1)))
    return message["std_msgs/msg/Header"](stamp, "camera")


def image(pixels: np.ndarray, encoding: str, time_s: float) -> object:
    """Return an image message."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    return message["sensor_msgs/msg/Image"](header(time_s), *pixels.shape[:2], encoding, 0, rows.shape[1], rows.ravel())


recording = fs.load_recording("rig")
[camera] = recording.cameras
K = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1.0])
lens = dict(height=camera.height, width=camera.width, distortion_model="plumb_bob", d=np.zeros(5), k=K, r=np.eye(3).ravel())
lens |= dict(p=np.insert(K, [3, 6, 9], 0.0), binning_x=0, binning_y=0)
lens["roi"] = message["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
with Writer(Path("take"), version=8, storage_plugin=StoragePlugin.MCAP) as bag:
    topics = {}

    def write(topic: str, time_s: float, content: object) -> None:
        """Write a message at a time."""
        kind = content.__msgtype__
        if topic not in topics:
            topics[topic] = bag.add_connection(topic, kind, typestore=store)
        bag.write(topics[topic], round(1e9 * time_s), store.serialize_cdr(content, kind))

    for k, time_s in enumerate(1.7e9 + recording.time_s):
        depth = cv2.imread(str(recording.cloud_files[k][0]), cv2.IMREAD_UNCHANGED).astype(float) * camera.depth_unit
        color = cv2.imread(str(recording.color_files[k][0]))[..., ::-1]
        write("/camera/depth/image_raw", time_s, image(depth.astype(np.float32), "32FC1", time_s))
        write("/camera/depth/camera_info", time_s, message["sensor_msgs/msg/CameraInfo"](header(time_s), **lens))
        write("/camera/color/image_raw", time_s, image(color, "rgb8", time_s))
        effort = message["sensor_msgs/msg/JointState"](header(time_s), ["flexor"], np.zeros(1), np.zeros(1), recording.inputs[k])
        write("/joint_states", time_s, effort)

# %% [markdown]
# ## Look, then import
#
# `inspect` lists what the bag contains. `import` makes a recording; `--free FROM:TO` marks the seconds without contact. The joint
# has the name of the cable here; otherwise `--map motor_1=cable_flexor` renames it.

# %%
shell("femsense inspect take")

# %%
shell("femsense import take -o recording --inputs tension --zero absolute --free 0:5.9")

# %% [markdown]
# ## Calibrate and estimate
#
# Without markers the clouds of the contact-free frames place the camera. The finger was pressed at a known point, which `--at` gives, in metres on the body at rest; without `--at` the contact is searched.

# %%
shell("femsense calibrate finger recording -o calibration.json")

# %%
shell("femsense estimate finger recording -c calibration.json --at 0.079,0,0.0148 -o run")

# %%
run = fs.read_run(Path("run"))
status = {frame.frame: frame.status for frame in run.frames}
for contact in run.contacts:
    if contact.force_n > 3 * contact.std_n:
        print(
            f"frame {contact.frame}: {contact.force_n:.3f} ± {1.96 * contact.std_n:.3f} N (95 %), true 0.300 N; {status[contact.frame]}"
        )

# %% [markdown]
# Trust a frame only if its status is `ok`, whatever its interval ([All statuses](../guides/statuses.md)).
#
# **Try the wrong colour.** Delete the line `probe_rgb`, and the probe becomes as orange as the finger. About 70 pixels at its edge then count as the robot's, no state of the finger fits them, and two of the
# four frames with contact are reported as `not explained` although their forces are nearly right. The same happens on a real table: press with something whose colour differs from the robot's.
#
# ## In the browser
#
# ```sh
# femsense view run
# ```
#
# opens a page with the moving robot, the measured points and the force arrows. `femsense export run -o robot.glb --arrows` writes the same as a glTF file, and `femsense stream run` sends it to headsets
# ([Headsets](../guides/headsets.md)).

# %%
shell("femsense export run -o robot.glb --arrows")
