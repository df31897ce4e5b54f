"""Judge a pose: ``inliers`` finds the inliers of the pose, and ``belief`` tells whether the pose is to be believed."""
