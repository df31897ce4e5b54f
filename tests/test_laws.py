"""The laws of ``laws.py`` for representative combinations; the whole product with ``-m slow``."""

from itertools import product

import pytest
import torch
from kornia.core.exceptions import ValueCheckError
from laws import CAMERAS, FOCALS, LAWS, NOISES, Case, applies, build, gradcheck, make

SOLVERS = ("pnpnet-set", "pnpnet-n9", "epnp-lm", "reppnp-lm", "p3p-ransac", "identity-lm")
DTYPES = torch.float64, torch.float32
#: Each solver, camera, noise, focal length and dtype in some combination.
QUICK = [
    Case("pnpnet-set"),
    Case("pnpnet-set", "rig", "covariance"),
    Case("pnpnet-set", "pixels", "sigma", "unknown"),
    Case("pnpnet-set", "bearings", dtype=torch.float32),
    Case("pnpnet-n9", "pixels", "covariance"),
    Case("pnpnet-n9", dtype=torch.float32),
    Case("epnp-lm", "pixels", "sigma"),
    Case("epnp-lm", "pixels", "covariance", dtype=torch.float32),
    Case("reppnp-lm", "rig"),
    Case("p3p-ransac", "pixels", "sigma"),
    Case("p3p-ransac", "bearings", "covariance"),
    Case("p3p-ransac", focal="unknown"),
    Case("p3p-ransac", focal="unknown", extra="radial"),
    Case("identity-lm", "pixels", "sigma", dtype=torch.float32),
    Case("identity-lm", "bearings"),
    Case("identity-lm", "rig", "covariance"),
    Case("pnpnet-set", extra="prior"),
    Case("epnp-lm", "pixels", "covariance", extra="prior"),
    Case("p3p-ransac", extra="confidence"),
    *(Case(name) for name in ("epnp", "reppnp", "net-n9", "net-set", "pnpnet-n6", "ransac-epnp-lm")),
]
ALL = [Case(*x) for x in product(SOLVERS, CAMERAS, NOISES, FOCALS, DTYPES)]


def params(cases, marks=()):
    pairs = ((law, case) for case in cases if not case.is_refused for law in LAWS if applies(law, case))
    return [pytest.param(law, case, id=f"{law.__name__}-{case}", marks=marks) for law, case in pairs]


@pytest.mark.parametrize(
    ("law", "case"), params(QUICK) + params([x for x in ALL if x not in QUICK], marks=[pytest.mark.slow])
)
def test_law(law, case):
    law(case)


@pytest.mark.parametrize("camera", ["rig", "bearings"])
@pytest.mark.parametrize("name", SOLVERS)
def test_what_the_contract_excludes_is_refused(name, camera):
    case = Case(name, camera, focal="unknown")
    assert case.is_refused
    with pytest.raises(ValueCheckError):
        build(case)(**make(case)[0])


CHECKED = [Case("identity-lm", *x) for x in product(CAMERAS, NOISES, FOCALS)]
IN_TIME = [CHECKED[0], Case("identity-lm", "rig", "covariance"), Case("identity-lm", "pixels", "sigma", "unknown")]


@pytest.mark.parametrize(
    "case",
    [pytest.param(x, id=str(x), marks=[] if x in IN_TIME else [pytest.mark.slow]) for x in CHECKED if not x.is_refused],
)
def test_gradcheck(case):
    gradcheck(case)
