"""Results of runs: their files, cards and summaries, sound or damaged."""

import json
import shutil
from collections import Counter
from dataclasses import replace

import pytest
from hypothesis import given
from strategies import many, names_the_file, places_in, spoiled

from kornia_pnpnet.core.files import write_json
from kornia_pnpnet.core.schema import to_json
from kornia_pnpnet.pretrained import WEIGHTS_FOLDER
from kornia_pnpnet.training.card import write_model_card
from kornia_pnpnet.training.results import find_results, load_run, summarize_runs


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
    results = load_run(WEIGHTS_FOLDER / "pnpnet-n9" / "results.json")
    overrides = ["train.ramp=[0,0]", override, "url=https://host/a", "weights=outputs/a/weights"]
    for origin in (results.origin, None):
        write_model_card(tmp_path, replace(results, overrides=overrides, origin=origin))
        card = (tmp_path / "README.md").read_text()
        assert "/runs" not in card
        assert "mine" not in card
        assert "train.ramp=[0,0]" in card
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
