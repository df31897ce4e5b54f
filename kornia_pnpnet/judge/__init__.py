"""Judgement of a pose: ``inliers`` finds its inliers, and ``belief`` tells whether the pose is to be believed."""
