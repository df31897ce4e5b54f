"""Model cards: written from the results of a run, without the machine that the run was on."""

import re
from dataclasses import replace

import pytest
from huggingface_hub import ModelCard

from kornia_pnpnet.pretrained import WEIGHTS_FOLDER, shipped_weights
from kornia_pnpnet.training.card import write_model_card
from kornia_pnpnet.training.results import load_run

RESULTS = load_run(WEIGHTS_FOLDER / "pnpnet-n9" / "results.json")


def card_of(results, folder, name=None):
    write_model_card(folder, results, name=name)
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
    overrides = ["train.ramp=[0,0]", override, "url=https://host/a", "weights=outputs/a/weights"]
    for origin in (RESULTS.origin, None):
        card = card_of(replace(RESULTS, overrides=overrides, origin=origin), tmp_path)
        assert "/runs" not in card
        assert "mine" not in card
        assert "train.ramp=[0,0]" in card
        assert "url=https://host/a weights=outputs/a/weights" in card


def test_a_card_names_the_run_that_each_run_began_with(tmp_path):
    card = card_of(RESULTS, tmp_path)
    names = [run.name for run in RESULTS.lineage()]
    assert names == ["pnpnet-n9", "ft-geman_mcclure-m10-n9", "two-views-n9"]
    places = [card.index(f"the weights of {name}") for name in names[:-1]]
    assert places == sorted(places)
    assert "`views` was 3 and is 2" in card  # the weights were changed in between


@pytest.mark.parametrize("name", shipped_weights())
def test_shipped_cards_are_those_of_their_results(name, tmp_path):
    folder = WEIGHTS_FOLDER / name
    results = load_run(folder / "results.json")
    card = (folder / "README.md").read_text()
    assert card_of(results, tmp_path, name) == card
    assert not re.search(r"[=\s`](/|~|[A-Z]:)\w", card)
    metadata = ModelCard(card).data
    assert (metadata.license, metadata.library_name, metadata.model_name) == ("apache-2.0", "kornia_pnpnet", name)
    rates = {entry.dataset_name: entry.metric_value for entry in metadata.eval_results}
    assert rates == {key: pytest.approx(entry.success.rate, abs=1e-4) for key, entry in results.validation.items()}
