"""Judge poses: ``inliers`` finds the inliers of a pose, and ``evidence`` decides whether a pose is believed."""
