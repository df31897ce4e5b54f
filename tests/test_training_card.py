"""Model cards: written from the results of a run, without the machine that the run was on."""

import copy
import json
import re

import pytest

from kornia_pnpnet.pretrained import WEIGHTS_FOLDER, shipped_weights
from kornia_pnpnet.training.results import write_model_card

RESULTS = json.loads((WEIGHTS_FOLDER / "pnpnet-set" / "results.json").read_text())


def card_of(results, folder):
    write_model_card(folder, results)
    return (folder / "README.md").read_text()


@pytest.mark.parametrize(
    "override",
    [
        "weights=/tmp/runs/mine",
        "weights=~/runs/mine",
        r"weights=C:\runs\mine",
        "weights=file:///runs/mine",
        "+data.scenes=[/runs/mine/a,'/runs/mine b']",
        "data={path:/runs/mine}",
    ],
)
def test_a_card_names_no_folder_of_a_machine(override, tmp_path):
    results = copy.deepcopy(RESULTS)
    results["overrides"] = ["train.ramp=[0,0]", override, "url=https://host/a", "weights=outputs/a/weights"]
    for card in (card_of(results, tmp_path), card_of({**results, "origin": None}, tmp_path)):
        assert "runs" not in card
        assert "mine" not in card
        assert "train.ramp=[0,0]" in card
        assert "url=https://host/a weights=outputs/a/weights" in card


def test_a_card_names_the_run_that_each_run_began_with(tmp_path):
    card = card_of(RESULTS, tmp_path)
    run, names = RESULTS["origin"], []
    while run:
        names.insert(0, run["config"]["name"])
        run = run.get("origin")
    assert len(names) == 4
    places = [card.index(f"from the weights of `{name}`") for name in names]
    assert places == sorted(places)
    assert "init.layers 4, now 3" in card  # the weights were changed in between


@pytest.mark.parametrize("name", shipped_weights())
def test_shipped_cards_are_those_of_their_results(name, tmp_path):
    results = json.loads((WEIGHTS_FOLDER / name / "results.json").read_text())
    write_model_card(tmp_path, results, name=name)
    card = (WEIGHTS_FOLDER / name / "README.md").read_text()
    assert (tmp_path / "README.md").read_text() == card
    assert not re.search(r"[=\s`](/|~|[A-Z]:)\w", card)
