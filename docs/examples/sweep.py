"""Train with several options and compare the networks: ``python docs/examples/sweep.py model.m=2,5 model.n=9,12``.

`train.py -m` trains a network for each combination of the options, which are Hydra's overrides with a comma, and adds a
row to `summary.csv` of the sweep after each training. This program then reads that table: what each network achieved,
and whether the best is apart from the others. Run again with more options, it only trains what is missing.
"""

import subprocess
import sys
from pathlib import Path

import pandas as pd
from shared import command

TRAIN = Path(__file__).resolve().parents[2] / "train.py"


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("overrides", nargs="*", help="default: model.m=2,5 optim.lr=1e-3,3e-3")
    parser.add_argument("--updates", type=int, default=500, help="of each training; 500 take about a minute")
    parser.add_argument("--data", default="uniform", help="the validation set that compares")
    options = parser.parse_args()
    overrides = options.overrides or ["model.m=2,5", "optim.lr=1e-3,3e-3"]
    folder = (options.out / "sweep").resolve()
    fixed = [f"hydra.sweep.dir={folder}", f"train.updates={options.updates}", "resume=true", "progress=false"]
    subprocess.run([sys.executable, str(TRAIN), "-m", *fixed, *overrides], check=True)

    # The columns are the overrides, then "update", speed, and the success on each set. An override may be "null".
    table = pd.read_csv(folder / "summary.csv", keep_default_na=False, na_values=[""])
    names = [override.lstrip("+").partition("=")[0] for override in overrides]
    rate, low, high = (f"{options.data}/{key}" for key in ("rate", "low", "high"))
    table = table[table["train.updates"] == options.updates].dropna(subset=names).sort_values(rate, ascending=False)
    print(table[[*names, "us_per_problem", rate, low, high]].to_string(index=False))
    best, *others = table.to_dict("records")
    near = [x for x in others if x[high] >= best[low]]
    print("best:", ", ".join(f"{name}={best[name]}" for name in names))
    print(f"The 95 % intervals of {len(near)} of the {len(others)} others overlap with the interval of the best.")


if __name__ == "__main__":
    main()
