"""An example of each public name, in the order of use. Needs the scans `monday/`, `tuesday/` and `fixes.csv`."""

import numpy as np

import segslam
from segslam import candidates

# %% open_dataset
dataset = segslam.open_dataset("monday", frames="0:12")
scans = list(dataset)

# %% Scan
scan = segslam.Scan(np.random.default_rng(0).normal(size=(500, 3)), stamp_ns=1_000_000_000)
print(scan.points.shape)

# %% load_config
config = segslam.load_config(overrides=["keyframes.distance_m=1.0", "verify.max_false_share=0.01"])

# %% Config
print(config.verify.max_false_share, segslam.Config().verify.max_false_share)

# %% keep_freed_memory
segslam.keep_freed_memory()  # once, before mapping many scans in your own program

# %% Slam
slam = segslam.Slam(config)
for scan in scans:
    step = slam.process(scan)
result = slam.finish()
print(result.trajectory.T_world_lidar[-1])

# %% BadScan
try:
    segslam.Slam().process(segslam.Scan(np.zeros((0, 3)), stamp_ns=0))
except segslam.BadScan as error:
    print(f"skipped: {error}")

# %% map_folder
run = segslam.map_folder("monday", "runs/monday", config=config)
print(run.metrics["num_loops_accepted"], run.result.trajectory.T_world_lidar.shape)

# %% read_run
run = segslam.read_run("runs/monday")

# %% SegslamError
try:
    segslam.read_run("runs/nothing")
except segslam.SegslamError as error:  # every error of bad input; its text names the file and the remedy
    print(error)

# %% register
found = segslam.register(scans[8].points, scans[0].points)
print(found.T_target_source if found else found.reason)

# %% Alignment
if isinstance(found, segslam.Alignment):
    print(found.overlap, found.rms_m)

# %% Rejected
nothing = segslam.register(np.zeros((0, 3)), scans[0].points)
if isinstance(nothing, segslam.Rejected):
    print(nothing.reason.value, nothing.detail)

# %% evaluate
figures = segslam.evaluate(run)  # or two files, or two arrays of poses (n, 4, 4)
print(figures["ate_m"])

# %% report
page = segslam.report("runs/monday")

# %% export
segslam.export("runs/monday", ["map.ply", "map.png"])

# %% replay
strict = segslam.replay("runs/monday", "runs/strict", settings=["verify.max_false_share=0.0001"])

# %% locate
pose = segslam.locate("runs/monday", scans[5].points)
print(pose.T_world_lidar if isinstance(pose, segslam.Located) else pose.reason)

# %% Locator
locator = segslam.Locator.from_run("runs/monday")  # reads the run once, for many scans
poses = [locator.locate(scan.points) for scan in scans[4:6]]

# %% Located
for pose in poses:
    if isinstance(pose, segslam.Located):
        print(pose.keyframe_id, pose.T_world_lidar)

# %% localise
second = segslam.localise("runs/monday", "tuesday", "runs/tuesday_in_monday")
print(second.metrics["localised_percent"])

# %% merge
segslam.map_folder("tuesday", "runs/tuesday", config=config)
both = segslam.merge(["runs/monday", "runs/tuesday"], "runs/both")
print(both.metrics["num_loops_between"])

# %% fleet
city = segslam.fleet(["monday", "tuesday"], "city", num_workers=1)

# %% Places
places = segslam.Places()
for number, scan in enumerate(scans):
    standing = scan.points[scan.points[:, 2] > -1.0]  # without the ground
    places.add(number, candidates.signature_of_standing(standing))
print(places.shortlist(candidates.signature_of_standing(standing), most=3))

# %% georeference
placed = segslam.georeference("runs/monday", "fixes.csv")
