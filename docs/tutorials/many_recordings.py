# %% [markdown]
# # Forty recordings at once
#
# A series of experiments gives one recording per trial. This tutorial makes a series with the virtual rig, estimates forces in all recordings with one command per step, and compares the
# results with the truth. It uses six recordings to be short; forty or four thousand take the same commands.

# %% tags=["setup"]
import shlex
import subprocess
import sys
from pathlib import Path

import pandas as pd


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
# ## The trials
#
# Each trial presses the finger of the package with another force. The recordings have markers only, so the contact point is given with `--at`.

# %%
forces_n = [0.05, 0.10, 0.15, 0.20, 0.25, 0.30]
script = """format = "femsense-script-1"
seed = {seed}

[[sweeps]]
label = "pull"
cables = {{ flexor = 1.5 }}
rest = 1
up = 5
down = 5

[[sweeps]]
label = "press"
cables = {{ flexor = 0.5 }}
hold = 1
up = 1
down = 1

[[contacts]]
sweep = "press"
point_m = [0.080, 0.0, 0.016]
force_n = {force}

[truth]
refinements = 0

[camera]
eye_m = [0.05, -0.25, 0.12]
target_m = [0.05, 0.0, 0.0]

[markers]
std_m = 0.1e-3
"""
for k, force in enumerate(forces_n):
    Path(f"trial-{k}.toml").write_text(script.format(seed=k, force=force))
# %% [markdown]
# ## Three commands
#
# With a camera you start at `calibrate`, after `femsense import`. Each command takes several paths, a pattern or a folder, and spreads the work over the cores of the machine (`--workers N`) or over a cluster
# (`--dask`). Run again, it does only what is missing. If trials need different robots or options, give them in a table (`--jobs`): [Many recordings](../guides/many.md).

# %%
shell("femsense simulate finger 'trial-*.toml' -o recordings")

# %%
shell("femsense calibrate finger recordings -o calibrations")

# %%
shell("femsense estimate finger recordings -c calibrations --at 0.080,0.0,0.016 -o runs")

# %% [markdown]
# ## One table over all
#
# `runs/summary.csv` has a row per recording; `runs/summary.html` shows the same with sorting and filters. A recording without a result has its reason in the row, and does not stop the others.

# %%
summary = pd.read_csv("runs/summary.csv")
print(summary[["name", "status", "frames", "contacts", "largest_force_n", "rms_after_m"]].round(4).to_string(index=False))

# %% [markdown]
# The forces of all trials, against the truth:

# %%
rows = []
for k, force in enumerate(forces_n):
    name = f"trial-{k}"
    contacts = pd.read_csv(f"runs/{name}/contacts.csv")
    pressed = contacts.loc[contacts["force_n"].idxmax()]
    rows.append((name, force, pressed["force_n"], 1.96 * pressed["std_n"]))
table = pd.DataFrame(rows, columns=["trial", "true [N]", "estimated [N]", "95 % interval [N]"])
print(table.round(3).to_string(index=False))

# %%
import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(5, 4))
axes.plot([0, 0.35], [0, 0.35], color="0.6", lw=1)
axes.errorbar(table["true [N]"], table["estimated [N]"], table["95 % interval [N]"], fmt="o", capsize=4)
axes.set_xlabel("true force [N]")
axes.set_ylabel("estimated force [N], 95 %")
figure.tight_layout()
figure.savefig("many-forces.png", dpi=110)
