"""Judge a pose: ``inliers`` finds its inliers by thresholds, ``evidence`` tells whether it is to be believed."""
