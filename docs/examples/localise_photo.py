"""Localise one photo against a few photos with known poses: ``python docs/examples/localise_photo.py``.

The photos are rendered: `rendered_hall.py` also gives the depth of each pixel, from which features of the reference
photos get their points. OpenCV finds SIFT features and the two nearest neighbours of each feature of the new photo in
each reference photo. Every nearest neighbour is a pair, right or wrong; `pnpnet-set` gets one minus Lowe's ratio as the
confidence of each pair and finds the pose. `localiser.py` does the same for many photos and a COLMAP model.
"""

import cv2
import numpy as np
import rendered_hall
import torch
from shared import pose_error

from kornia_pnpnet import Pose, create_solver

SIFT = cv2.SIFT_create(nfeatures=1000)


def features(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (M, 2), where (0.5, 0.5) is the centre of the first pixel, and descriptors (M, 128)."""
    keypoints, descriptors = SIFT.detectAndCompute(image, None)
    return np.array([x.pt for x in keypoints]) + 0.5, descriptors


def main() -> None:
    # In place of these: your photos, with the points (M, 3) of the features of each reference photo, NaN where unknown.
    hall = rendered_hall.make_hall()
    references = rendered_hall.reference_views(hall, 8)
    photo = next(rendered_hall.query_views(hall, 1))

    pixels, descriptors = features(photo.image)
    pairs = []
    for reference in references:
        their_pixels, theirs = features(reference.image)
        points = rendered_hall.seen_points(reference, their_pixels)
        for best, second in cv2.BFMatcher().knnMatch(descriptors, theirs, k=2):
            point, pixel, ratio = points[best.trainIdx], pixels[best.queryIdx], best.distance / second.distance
            pairs += [(*point, *pixel, 1.0 - ratio)] if np.isfinite(point).all() else []
    world_points, img_points, confidence = torch.tensor(pairs).split((3, 2, 1), dim=1)

    solver, intrinsics = create_solver("pnpnet-set"), torch.from_numpy(rendered_hall.INTRINSICS)
    with torch.no_grad():
        result = solver(world_points, img_points, intrinsics, confidence=confidence[:, 0])
    print(f"{len(pairs)} pairs, {result.inliers.sum()} of them inliers; ok: {result.ok.item()}")
    metres, degrees = pose_error(result.pose, Pose(*map(torch.from_numpy, (photo.rotation, photo.translation))))
    print(f"{100 * metres:.1f} cm and {degrees:.2f}° from the true pose")
    print(result)


if __name__ == "__main__":
    main()
