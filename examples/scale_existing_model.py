"""Scale an existing COLMAP model to metres with a UWB log and anchors at unknown positions.

    python examples/scale_existing_model.py sparse/0 images.csv uwb.csv metric/0 --tag_in_cam 0.03 -0.12 -0.05

The log is canonical CSV (timestamp_s,anchor_id,range_m), images.csv has image_name,timestamp_s. The lever arm is
the vector from the lens to the antenna: metres right, down and forward of the camera. The clocks of camera and radio
may differ: without --time_offset (image time = range time + offset, seconds), the difference is searched for.
"""

import argparse
from pathlib import Path

import pycolmap

import rangesfm

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
for name in ("model_path", "image_times_path", "log_path", "output_path"):
    parser.add_argument(name, type=Path)
parser.add_argument("--tag_in_cam", nargs=3, type=float, required=True, metavar="M", help="0 0 0 where it is not known")
parser.add_argument("--time_offset", type=float, metavar="SECONDS")
args = parser.parse_args()
tag_in_cam_m = tuple(args.tag_in_cam)

reconstruction = pycolmap.Reconstruction(args.model_path)
times = rangesfm.read_image_times_csv(args.image_times_path).by_name()

log = rangesfm.read_ranges(args.log_path)
trajectory = rangesfm.trajectory_from_reconstruction(reconstruction, times)
time_offset_s = args.time_offset
if time_offset_s is None:
    found = rangesfm.estimate_time_offset(log, trajectory, tag_in_cam_m)
    time_offset_s = found.value_s
    print(f"time offset {time_offset_s:+.3f} s, standard deviation {found.stddev_s:.3f} s")
observations = rangesfm.associate(log, trajectory, tag_in_cam_m, time_offset_s=time_offset_s)
anchors = [rangesfm.Anchor(anchor_id) for anchor_id in log.anchor_ids]
estimate = rangesfm.initialize_scale(observations, trajectory, anchors, anchor_frame="unknown")
low, high = estimate.interval_95  # of this map, which is scaled only; rangesfm.run_survey judges the refined one
print(f"{estimate.value:.4f} m per unit, 95 % interval {low:.4f} to {high:.4f}, {estimate.verdict}")

metric, summary = rangesfm.refine_with_ranges(
    rangesfm.rescale(reconstruction, estimate.metric_from_sfm),
    trajectory,
    estimate.ranges.observations,
    estimate.metric_from_sfm,
    estimate.ranges.anchors,
    estimate.ranges.errors,
    tag_in_cam_m=tag_in_cam_m,
    first_pose_is_fixed=True,
)
print(f"refined in {summary.num_iterations} iterations, {summary.reprojection_rms_px:.2f} px")
args.output_path.mkdir(parents=True, exist_ok=True)
metric.write(args.output_path)
