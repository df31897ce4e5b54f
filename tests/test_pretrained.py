"""The shipped weights, the success they must reach, and the files, cards and summaries of the results of runs."""

import hashlib
import json
import math
import os
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import many, names_the_file, places_in, rate, spoiled
from hypothesis import given
from kornia.core.exceptions import ValueCheckError
from safetensors import safe_open

from kornia_pnpnet import PnPNet, RobustWeightedLM, create_solver, shipped_weights
from kornia_pnpnet.core.files import digest, write_json
from kornia_pnpnet.core.schema import to_json
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.metrics import reliability
from kornia_pnpnet.pretrained import WEIGHTS_FOLDER, read_weights, write_weights
from kornia_pnpnet.propose.epnp import EPnP
from kornia_pnpnet.training.card import write_model_card
from kornia_pnpnet.training.results import find_results, load_run, summarize_runs

# Success without outliers and with a random number of outliers: about two points below what the training run found.
FLOORS = {6: (0.67, 0.53), 9: (0.85, 0.77), 12: (0.92, 0.87), 20: (0.97, 0.95)}
# Of the one set of weights for any rotation and any number of pairs.
SET_FLOORS = {6: (0.71, 0.55), 9: (0.88, 0.79), 12: (0.94, 0.89), 20: (0.98, 0.97), 50: (0.99, 0.99)}
CASES = [(f"pnpnet-n{n}", n, floors, torch.float64) for n, floors in FLOORS.items()]
CASES += [("pnpnet-set", n, floors, torch.float32) for n, floors in SET_FLOORS.items()]
CASES += [("pnpnet-n9", 9, FLOORS[9], torch.float32)]
#: Options that are too large.
LARGE = [("init", "width", 2**17), ("init", "layers", 10**7), ("refine", "m", 10**9), ("refine", "by_residual", 10**12)]


@pytest.mark.parametrize(("name", "n", "floors", "dtype"), CASES)
def test_success_on_problems_that_nothing_else_uses(name, n, floors, dtype):
    common = {"n": n, "batch_size": 4000, "dtype": dtype} | ({"max_angle": math.pi} if name == "pnpnet-set" else {})
    solver, sound = create_solver(name), SyntheticProblems(seed=555_001, **common).batch(0)
    mixed = SyntheticProblems(seed=555_002, outliers=OutlierMix(), **common).batch(0)
    for problems, floor in zip((sound, mixed), floors, strict=True):
        assert rate(solver(*problems[:3]), problems) >= floor
    if name != "pnpnet-set":
        assert rate(create_solver(f"net-n{n}")(*sound[:3]), sound) < floors[0] / 2
    few = sound.map(lambda x: x[:400])  # the search for a pose of garbage takes long
    garbage = few._replace(img_points=few.img_points.roll(1, 0))  # every pixel belongs to another problem
    assert solver(*sound[:3]).ok.float().mean() > 0.99
    assert solver(*garbage[:3]).ok.float().mean() < 0.1


@pytest.mark.parametrize("name", ["no-such-name", "", "a/b/c"])
def test_an_unknown_name_is_an_error_that_lists_the_shipped_weights_without_a_network(name, monkeypatch):
    for target in ("socket.socket.connect", "socket.getaddrinfo"):
        monkeypatch.setattr(target, lambda *_: pytest.fail("a connection was opened"))
    with pytest.raises(FileNotFoundError) as raised:
        PnPNet.from_pretrained(name)
    assert all(shipped in str(raised.value) for shipped in shipped_weights())
    with pytest.raises(FileNotFoundError):  # a path is no name
        PnPNet.from_pretrained(Path("pnpnet-set"))


def test_weights_of_the_set_network_are_inlier_probabilities():
    solver, mix = create_solver("pnpnet-set"), OutlierMix()
    drawn = [SyntheticProblems(n=n, batch_size=2000, seed=555_013 + n, outliers=mix).batch(0) for n in (6, 9, 20, 50)]
    chance = torch.cat([solver.with_starts(*p[:3], first_stage_only=True)[1].weights.flatten() for p in drawn])
    truth = torch.cat([p.inliers.flatten() for p in drawn])
    assert reliability(chance, truth).expected_error < 0.05
    assert (chance - truth.float()).abs().mean() < 0.25  # a constant would be calibrated, too


@pytest.mark.parametrize("name", shipped_weights())
def test_shipped_weights_have_a_checksum_and_the_card_of_their_run(name, tmp_path):
    folder = WEIGHTS_FOLDER / name
    results = load_run(folder / "results.json")
    write_model_card(tmp_path, results, name=name)
    assert (tmp_path / "README.md").read_text() == (folder / "README.md").read_text()
    loaded = PnPNet.from_pretrained(name).config()
    for part in ("init", "refine", "normalize"):  # runs recorded options that there are no longer, too
        recorded = results.model[part]
        assert all(recorded[option] == value for option, value in loaded[part].items() if option in recorded)
    assert sum(path.stat().st_size for path in folder.iterdir()) < 2_000_000
    with safe_open(folder / "model.safetensors", "pt") as file:
        assert "sha256" in file.metadata()  # which loading compares: `test_damaged_weights_load_nothing`


@pytest.mark.parametrize(("part", "name", "value"), LARGE)
def test_weights_that_are_not_finite_or_of_another_size_are_refused(part, name, value, tmp_path):
    config, state = read_weights("pnpnet-set")
    config[part][name] = value
    write_weights(tmp_path, config, state)
    with pytest.raises(ValueCheckError, match=rf"{name} is {value}, too large"):
        PnPNet.from_pretrained(tmp_path)


def test_a_solver_that_could_not_be_loaded_is_not_saved(tmp_path):
    with pytest.raises(ValueCheckError, match=r"iterations is 1500, too large"):
        PnPNet(EPnP(iterations=1500), RobustWeightedLM(5)).save_pretrained(tmp_path)
    solver = create_solver("pnpnet-n9")
    solver.refine.step.raw.data.fill_(torch.nan)
    with pytest.raises(ValueCheckError, match="not finite"):
        solver.save_pretrained(tmp_path)
    assert not any(tmp_path.iterdir())
    config, state = read_weights("pnpnet-set")
    write_weights(tmp_path, config, {**state, "pair.bias": torch.full((4,), torch.nan)})
    with pytest.raises(ValueCheckError, match=r"not finite: pair\.bias"):
        PnPNet.from_pretrained(tmp_path)


def test_digests_tell_contents_apart():
    x = torch.arange(6.0).reshape(2, 3)
    assert digest("a", b"b") == hashlib.sha256(b"ab").hexdigest()
    assert digest({"a": 1, "b": [2]}) == digest({"b": [2], "a": 1})
    assert digest(x.mT.contiguous().mT.requires_grad_()) == digest(x)
    others = (x.reshape(3, 2), x.double(), x.bfloat16(), x > 2, x + 1, x.int(), x.new_zeros(0), torch.tensor(1.0))
    assert len({digest(tensor) for tensor in (x, *others)}) == 1 + len(others)


@pytest.mark.parametrize(("content", "error"), [({"a": float("nan")}, ValueError), ([1, object()], TypeError)])
def test_content_that_json_does_not_have_leaves_the_old_file(tmp_path, content, error):
    path = tmp_path / "folder" / "a.json"
    write_json(path, {"a": 1})
    with pytest.raises(error):
        write_json(path, content)
    assert json.loads(path.read_text()) == {"a": 1}
    assert [*path.parent.iterdir()] == [path]
    os.mkfifo(path.with_name("pipe"))
    with pytest.raises(OSError, match="pipe"):  # it would be replaced by a file
        write_json(path.with_name("pipe"), {})


def test_a_card_names_no_folder_of_a_machine(tmp_path):
    results = load_run(WEIGHTS_FOLDER / "pnpnet-n9" / "results.json")
    overrides = ["train.ramp=[0,0]", "weights=/tmp/runs/mine", "weights=~/runs/mine", r"weights=C:\runs\mine"]
    overrides += ["weights=file:///runs/mine", "+data.scenes=[/runs/mine/a,'/runs/mine b']", "data={path:/runs/mine}"]
    overrides += ["url=https://host/a", "weights=outputs/a/weights"]
    for origin in (results.origin, None):
        write_model_card(tmp_path, replace(results, overrides=overrides, origin=origin))
        card = (tmp_path / "README.md").read_text()
        assert not any(word in card for word in ("/runs", "mine"))
        assert "'train.ramp=[0,0]'" in card  # as a shell reads it
        assert "url=https://host/a weights=outputs/a/weights" in card


def test_spoiled_results_of_runs_are_an_error_of_ours(tmp_path):
    weights = tmp_path / "run" / "weights"
    shutil.copytree(WEIGHTS_FOLDER / "pnpnet-n6", weights)
    path = (weights / "results.json").rename(tmp_path / "run" / "results.json")
    content = json.loads(path.read_text())
    places, outcomes = list(places_in(content)), Counter()

    @many(150)
    @given(spoiled(content, places))
    def run(results):
        path.write_text(json.dumps(results))
        card = tmp_path / "README.md"
        card.unlink(missing_ok=True)
        try:
            loaded = load_run(path)
            write_json(tmp_path / "again.json", to_json(loaded))
            assert find_results(weights) == loaded == load_run(tmp_path / "again.json")
        except ValueError as error:
            outcomes["refused"] += 1
            names_the_file(error, path)
            with pytest.warns(UserWarning, match="Left out of the summary"):
                assert summarize_runs(tmp_path) is None
        else:
            outcomes["works"] += 1
            write_model_card(tmp_path, loaded)
            assert card.stat().st_size > 1000
            assert summarize_runs(tmp_path).read_text().count("\n") >= 2
            (tmp_path / "summary.csv").unlink()

    run()
    assert min(outcomes["refused"], outcomes["works"]) >= 5
