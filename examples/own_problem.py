"""Add range residuals to a bundle adjustment of your own, using only the cost functions.

    python examples/own_problem.py sparse/0

Every photo gets one made-up range to an anchor at (1, 2, 0). Replace these by your own ranges.
"""

import sys

import numpy as np
import pycolmap

from rangesfm import costs

reconstruction = pycolmap.Reconstruction(sys.argv[1])
anchor_in_world, range_bias_m = np.array([1.0, 2.0, 0.0]), np.array([0.0])
tag_in_cam_m = np.zeros(3)

config = pycolmap.BundleAdjustmentConfig()
for image_id in reconstruction.reg_image_ids():
    config.add_image(image_id)
# COLMAP's usual gauge fixes the scale, so that the ranges could not change it.
config.fix_gauge(pycolmap.BundleAdjustmentGauge.UNSPECIFIED)
adjuster = pycolmap.create_default_ceres_bundle_adjuster(
    pycolmap.BundleAdjustmentOptions(print_summary=False), config, reconstruction
)
for frame_id in reconstruction.reg_frame_ids():
    rig_from_world = reconstruction.frame(frame_id).rig_from_world
    if rig_from_world is None:
        continue
    center = rig_from_world.inverse().translation
    range_m = float(np.linalg.norm(center - anchor_in_world))
    cost = costs.range_cost(range_m=range_m, tag_in_cam_m=tag_in_cam_m, stddev_m=0.1, loss_scale=2.4)
    blocks = [rig_from_world.params, anchor_in_world, range_bias_m]
    costs.add_residual_block(adjuster, cost, None, blocks)
adjuster.problem.set_parameter_block_constant(anchor_in_world)
adjuster.problem.set_parameter_block_constant(range_bias_m)
print(adjuster.solve().brief_report())
