"""Judge a pose: ``inliers`` finds its inliers by thresholds, and ``evidence`` decides whether the pose is believed."""
