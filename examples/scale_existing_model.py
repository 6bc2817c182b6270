"""Scale an existing COLMAP model to metres with a UWB log and anchors at unknown positions.

    python examples/scale_existing_model.py sparse/0 images.csv uwb.csv metric/0

The log is canonical CSV (timestamp_s,anchor_id,range_m). images.csv has image_name,timestamp_s on the same clock.
"""

import sys
from pathlib import Path

import pycolmap

import rangesfm

model_path, image_times_path, log_path, output_path = map(Path, sys.argv[1:5])
tag_in_cam_m = (0.0, 0.0, 0.0)  # the radio's antenna in the camera frame: x right, y down, z forward

reconstruction = pycolmap.Reconstruction(model_path)
times = rangesfm.read_image_times_csv(image_times_path).by_name()

log = rangesfm.read_ranges(log_path)
trajectory = rangesfm.trajectory_from_reconstruction(reconstruction, times)
observations = rangesfm.associate(log, trajectory, tag_in_cam_m)
anchors = [rangesfm.Anchor(anchor_id) for anchor_id in log.anchor_ids]
estimate = rangesfm.initialize_scale(observations, trajectory, anchors, anchor_frame="unknown")
low, high = estimate.interval_95  # of this map, which is scaled only; rangesfm.run_survey judges the refined one
print(f"{estimate.value:.4f} m per unit, 95 % interval {low:.4f} to {high:.4f}, {estimate.verdict}")

metric, summary = rangesfm.refine_with_ranges(
    rangesfm.rescale(reconstruction, estimate.metric_from_sfm),
    trajectory,
    estimate.observations,
    estimate.metric_from_sfm,
    estimate.anchors,
    estimate.errors,
    tag_in_cam_m=tag_in_cam_m,
    first_pose_is_fixed=True,
)
print(f"refined in {summary.num_iterations} iterations, {summary.reprojection_rms_px:.2f} px")
output_path.mkdir(parents=True, exist_ok=True)
metric.write(output_path)
