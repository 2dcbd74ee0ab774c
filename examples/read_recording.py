"""From a run to numbers: run octarm, export the recording, read it back, plot three things worth seeing.

    python examples/read_recording.py [RECORDING.mcap]

Without a recording it makes one: ten segments, 60 s of the arm's time. It leaves read_recording.png. The cells
(# %%) are those of VS Code, Spyder and PyCharm.
"""

# %% A recording: given, or made here
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

scratch = tempfile.TemporaryDirectory(prefix="octarm-example-")
work = Path(scratch.name)
given = [Path(word) for word in sys.argv[1:] if word.endswith(".mcap")]
recording = given[0] if given else work / "run" / "recording.mcap"


def octarm(*words: str | Path) -> None:
    """The command line, of the same Python as this script."""
    subprocess.run([sys.executable, "-m", "launcher", *map(str, words), "--quiet"], check=True)


if not given:
    octarm("run", "--ticks", "600", "--no-plot", "--out", work / "run")
octarm("export", recording, "--npz", "--out", work / "run.npz")

# %% Everything in arrays: (ticks, nodes, fields); the names of the fields are there as well
data = np.load(work / "run.npz")
run = json.loads(str(data["run_json"]))
time, truth, estimate = data["time_s"], data["truth"], data["estimate"]
curvature = list(data["estimate_fields"]).index("curvature_per_m")
print(f"{run['nodes']} nodes, {run['ticks']} ticks of {run['tick_s']} s, arm {run['arm']['name']}")

# %% How fast does the estimate's error decay? A line through the logarithm of its norm, down to a tenth
error = np.sqrt(np.einsum("kij,ij->k", (estimate - truth) ** 2, data["energy_weights"]))
usable = np.isfinite(error) & (error > 0.1 * error[0])
slope, level = np.polyfit(time[usable], np.log(error[usable]), 1)
print(f"the error decays with {-slope:.4f} 1/s, from {error[0]:.3g} to {error[-1]:.3g} sqrt(J)")

# %% How long does a sweep take? (0: none ended in that tick)
durations = data["sweep_timing"][:, list(data["sweep_timing_fields"]).index("duration_wall_ns")]
durations = 1e-6 * durations[durations > 0.0]
p50, p99 = np.percentile(durations, [50, 99])
print(f"a sweep takes {p50:.2f} ms (median), {p99:.2f} ms (99 of 100 take less)")

# %% The same as a table, if pandas is there: a row a tick and node (--parquet is quicker for long runs)
try:
    import pandas as pd
except ImportError:
    print("no pandas here, so no table")
else:
    octarm("export", recording, "--csv", "--out", work / "csv")
    nodes = pd.read_csv(work / "csv" / "nodes.csv")
    wrong = (nodes["estimate_curvature_per_m"] - nodes["truth_curvature_per_m"]).abs()
    print("largest error of the curvature [1/m] at each node:", wrong.groupby(nodes["node"]).max())

# %% Three pictures
figure, axes = plt.subplots(3, 1, figsize=(7, 9), layout="constrained")
axes[0].plot(time, truth[:, ::3, curvature], "k", lw=1)
axes[0].plot(time, estimate[:, ::3, curvature], "--", lw=1)
axes[0].set(
    xlabel="time [s]", ylabel="curvature [1/m]", title="every third node: truth (black), estimate"
)
axes[1].semilogy(time, error, time, np.exp(level + slope * time), "--")
axes[1].set(
    xlabel="time [s]", ylabel="estimation error [sqrt(J)]", title=f"decays with {-slope:.3f} 1/s"
)
axes[2].hist(durations, bins=np.geomspace(durations.min(), 1.01 * durations.max(), 40))
axes[2].set(xlabel="sweep, wall clock [ms]", ylabel="ticks", xscale="log")
figure.savefig("read_recording.png", dpi=120)
scratch.cleanup()
