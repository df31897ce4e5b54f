"""Solvers and bounds by name: options, default solvers of a comparison, missing packages."""

from __future__ import annotations

import pytest
from kornia.core.exceptions import ValueCheckError

from kornia_pnpnet import PnPNet, list_solvers
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.evaluation.comparison import SeesTruth
from kornia_pnpnet.evaluation.named_solvers import BOUNDS, default_solvers, load_solver, missing_package


def test_bounds_take_options():
    bound = load_solver("known-inliers-and-noise:world_sigma=0.01")
    assert isinstance(bound, KnownInliersAndNoise)
    assert bound.config == {"img_sigma": 1.0, "world_sigma": 0.01}
    assert not bound.training
    with pytest.raises(ValueCheckError, match="known-inliers"):
        load_solver("known-inliers:world_sigma=0.01")


def test_a_name_wins_over_a_folder_of_that_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("known-inliers", "identity-lm"):
        (tmp_path / name).mkdir()
    assert isinstance(load_solver("known-inliers"), SeesTruth)
    assert isinstance(load_solver("identity-lm"), PnPNet)


@pytest.mark.parametrize("sources", [["synthetic", "a/room"], ["a/room"]])
def test_default_solvers_load_and_cover_every_n(sources):
    specs = default_solvers([6, 9], sources)
    assert len(set(specs)) == len(specs)
    assert set(default_solvers(9, sources)) | set(default_solvers(6, sources)) == set(specs)
    for spec in specs:
        assert isinstance(load_solver(spec), SeesTruth) == (spec.partition(":")[0] in BOUNDS)
    left = set(list_solvers()) - {spec.partition(":")[0] for spec in specs}
    assert all(name.startswith(("pnpnet-", "net-")) and not name.endswith(("-n6", "-n9")) for name in left)


def test_missing_packages_are_named_and_left_out(monkeypatch):
    needed = {
        "opencv-usac": "OpenCV",
        "poselib": "PoseLib",
        "pycolmap": "pycolmap",
        "kornia-rs": "kornia-rs",
        "epnp": None,
    }
    assert {name: missing_package(name) for name in needed} == dict.fromkeys(needed)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert {name: missing_package(name) for name in needed} == needed
    assert not any(name.startswith(("opencv", "kornia-rs", "poselib", "pycolmap")) for name in default_solvers(9))
