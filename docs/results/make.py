"""Measure and write the results page: ``python docs/results/make.py measure`` and ``... render``.

- ``measure`` solves fresh problems with every solver and writes the results files here, without the errors of single
  problems. The errors are in ``outputs/results``; a run that was stopped continues from there. The scenes are read from
  ``--scenes``.
- ``compare`` solves the scenes with two trained networks (``--runs``: two folders of ``train.py``) and writes
  ``distribution.json``.
- ``ship`` puts the weights of a training into the package (``--runs``: the folders of its runs, in their order).
- ``render`` writes ``README.md`` and ``real_matches.md`` from their templates and the results files, all pictures, and
  the overview in the README of the repository and on the home page. Every number comes from the files.

``ablation.csv``, ``sweep.csv`` and ``capacity.csv`` are copies of ``summary.csv`` of these trainings. Each takes less
than an hour on one core, and continues where it was stopped::

    SHORT="train.updates=4000 validation_size=5000 threads=1 hydra.sweep.dir=outputs/ablation resume=true"
    python train.py -m experiment=recipe $SHORT
    python train.py -m experiment=net_loss_only,identity_start,shared,additive,uncentred $SHORT
    python train.py -m experiment=kernels $SHORT
    python train.py -m experiment=sweep compile=true threads=1 hydra.sweep.dir=outputs/sweep resume=true
    python train.py -m experiment=capacity validation_size=5000 hydra.sweep.dir=outputs/capacity resume=true

The trainings of ``distribution.json`` take minutes::

    RUN="train.py model.n=9 model.m=5 train.updates=6000"
    python $RUN data=mixed name=mixed hydra.run.dir=outputs/distribution/mixed
    python $RUN data=paper name=paper hydra.run.dir=outputs/distribution/paper
    python docs/results/make.py compare --runs outputs/distribution/mixed outputs/distribution/paper
"""

import argparse
import os
from pathlib import Path

from measure import HERE, OTHERS, RESULTS, compare, measure, ship


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("measure", "compare", "ship", "render"))
    files = [name for name in (*RESULTS, *OTHERS) if name != "distribution"]  # `compare` writes this file
    parser.add_argument("--only", nargs="+", default=(), choices=files, help="for measure: these files")
    scenes = HERE.parents[2] / "shared" / "data"
    parser.add_argument("--scenes", type=Path, default=scenes, help="folder of the scenes (default: %(default)s)")
    parser.add_argument("--synthetic-count", type=int, default=5000, help="problems of a synthetic set")
    parser.add_argument("--real-count", type=int, default=1000, help="problems of a scene")
    parser.add_argument("--runs", type=Path, nargs="+", help="folders: `mixed` and `paper` for compare, all for ship")
    arguments = parser.parse_args()
    arguments.scenes = Path(os.path.relpath(arguments.scenes))  # results files name no folder of a machine
    if arguments.step == "measure":
        measure(arguments.scenes, arguments.synthetic_count, arguments.real_count, arguments.only)
    elif arguments.step == "compare":
        compare(arguments.scenes, arguments.real_count, arguments.runs)
    elif arguments.step == "ship":
        ship(arguments.runs)
    else:
        from render import render  # needs matplotlib

        render()


if __name__ == "__main__":
    main()
