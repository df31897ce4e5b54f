"""The laws of ``laws.py`` for representative combinations; the whole product with ``-m slow``."""

from itertools import product

import pytest
import torch
from helpers import assert_same, make_scene, many, other_defaults
from hypothesis import given
from hypothesis import strategies as st
from laws import CAMERAS, FOCALS, LAWS, NOISES, PEERS, Case, applies, build, gradcheck

from kornia_pnpnet import create_solver, data
from kornia_pnpnet.core.trees import map_tensors

SOLVERS = ("pnpnet-set", "pnpnet-n9", "epnp-lm", "reppnp-lm", "p3p-ransac", "identity-lm")
ALL = [Case(*x) for x in product(SOLVERS, CAMERAS, NOISES, FOCALS, (torch.float64, torch.float32))]
ALL = [case for case in ALL if not case.is_refused]
#: Each solver, camera, noise, focal length and dtype in some combination, and what else there is.
QUICK = [
    *ALL[::11],
    *(Case(name) for name in ("epnp", "reppnp", "net-n9", "net-set", "pnpnet-n6", "ransac-epnp-lm", *PEERS)),
    Case("pnpnet-set", "pixels", "sigma", "unknown"),
    Case("pnpnet-set", "rig", "sigma"),
    Case("p3p-ransac", focal="unknown", extra="radial"),
    Case("p3p-ransac", extra="confidence"),
    Case("p3p-ransac", "pixels", "sigma", extra="fisheye"),
    *(Case(*x, extra=y) for x in (["pnpnet-set"], ["epnp-lm", "pixels", "covariance"]) for y in ("prior", "dist")),
    *(Case(name, dtype=torch.float32) for name in PEERS),
]
FEW_GRADIENTS = [Case("identity-lm", *x) for x in ([], ["rig", "covariance"], ["pixels", "sigma", "unknown"])]
FEW_GRADIENTS += [Case("identity-lm", extra="prior"), Case("identity-lm", focal="unknown", extra="radial")]
GRADIENTS = [Case("identity-lm", *x) for x in product(CAMERAS, NOISES, FOCALS)]
POINTS = st.sampled_from([None, data.BoxPoints(), data.SlabPoints(), data.DrivePoints()])
MIXES = st.sampled_from([{}, {"count": 2}, {"max_ratio": 0.5, "mismatch_share": 0.5}])


def params(laws, quick, cases):
    cases = [*quick, *(x for x in cases if x not in quick)]
    pairs = ((law, case) for case in cases if not case.is_refused for law in laws if applies(law, case))
    for law, case in pairs:
        yield pytest.param(law, case, id=f"{law.__name__}-{case}", marks=() if case in quick else pytest.mark.slow)


@pytest.mark.parametrize(("law", "case"), [*params(LAWS, QUICK, ALL), *params([gradcheck], FEW_GRADIENTS, GRADIENTS)])
def test_law(law, case):
    try:
        build(case)
    except ImportError as error:
        pytest.skip(str(error))
    law(case)


@many(60)
@given(POINTS, st.integers(4, 15), st.integers(0, 1000), MIXES)
def test_both_precisions_see_the_same_problems(points, n, seed, outliers):
    options = {"n": n, "batch_size": 3, "seed": seed, "outliers": data.OutlierMix(**outliers)}
    if points is None:
        source, options = data.SceneProblems, {"scene": make_scene(20, 25), **options}
    else:
        source, options = data.SyntheticProblems, {"points": points, "axis_ratio": 3.0, "known_noise": 1.0, **options}
    single, double = (source(**options, dtype=dtype).batch(seed) for dtype in (torch.float32, torch.float64))
    assert double.world_points.dtype == torch.float64
    assert_same(single, map_tensors(lambda x: x.float() if x.is_floating_point() else x, double))


KINDS = {"structured_share": 0.5, "near_share": 0.2, "crowd_share": 0.3, "point_crowd_share": 0.5}
EVERY_KIND = data.OutlierMix(max_ratio=0.5, mismatch_share=0.3, **KINDS)
SOURCES = [data.SyntheticProblems(n=9, batch_size=4, outliers=EVERY_KIND)]
SOURCES += [data.CameraProblems(n=9, batch_size=4, cameras=3)]
SOURCES += [data.VaryingSize(data.SyntheticProblems, n=[5, 9], batch_size=4)]


@pytest.mark.parametrize("source", SOURCES)
def test_problems_do_not_depend_on_defaults(source):
    expected = source.batch(1)
    with other_defaults(torch.float64):
        assert_same(source.batch(1), expected)


@pytest.mark.parametrize("name", ["pnpnet-set", "epnp-lm"])
def test_built_solvers_do_not_depend_on_the_default_dtype(name):
    problems = data.SyntheticProblems(n=12, batch_size=3, seed=1).batch(0)
    expected = create_solver(name)(*problems[:3])
    with other_defaults(torch.float64, "cpu"):
        assert_same(create_solver(name)(*problems[:3]), expected)
