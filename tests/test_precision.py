"""Precision outside of solvers: both dtypes see the same problems, and heat maps of half precision are converted."""

import pytest
import torch
from data_helpers import make_scene, same
from helpers import assert_same
from hypothesis import given
from hypothesis import strategies as st
from strategies import many

from kornia_pnpnet import heatmap_keypoints
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.data import BoxPoints, DrivePoints, OutlierMix, SceneProblems, SlabPoints, SyntheticProblems


@many(60)
@given(
    st.sampled_from([None, BoxPoints(), SlabPoints(), DrivePoints()]),
    st.integers(4, 15),
    st.integers(0, 1000),
    st.sampled_from([{}, {"count": 2}, {"max_ratio": 0.5, "mismatch_share": 0.5}]),
)
def test_both_precisions_see_the_same_problems(points, n, seed, outliers):
    options = {"n": n, "batch_size": 3, "seed": seed, "outliers": OutlierMix(**outliers)}
    if points is None:
        source, options = SceneProblems, {"scene": make_scene(20, 25), **options}
    else:
        source, options = SyntheticProblems, {"points": points, "axis_ratio": 3.0, "known_noise": 1.0, **options}
    single, double = (source(**options, dtype=dtype).batch(seed) for dtype in (torch.float32, torch.float64))
    assert double.world_points.dtype == torch.float64
    assert same(single, map_tensors(lambda x: x.float() if x.is_floating_point() else x, double))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_heat_maps_of_half_precision_are_those_of_float32(dtype, generator):
    heatmaps = torch.randn(1, 2, 4, 5, generator=generator).to(dtype)
    assert_same(heatmap_keypoints(heatmaps), heatmap_keypoints(heatmaps.float()))
