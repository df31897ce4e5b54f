"""Whether a pose is to be believed: ``inliers`` says which pairs support it, ``belief`` what they say of it."""
