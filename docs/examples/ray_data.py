"""Solve very many problems with Ray Data, on one machine or on a cluster: ``python docs/examples/ray_data.py IN OUT``.

IN is a Parquet file or a folder of them with one problem per row, OUT a folder for the poses; either may be an address
such as ``s3://bucket/poses``. The columns are those of :class:`kornia_pnpnet.arrow.Solve`; other columns are kept. On a
node of a cluster, or with ``ray job submit``, Ray finds the cluster; elsewhere it starts on this machine.

With ``--id NAME``, a column of unique numbers, Ray writes down which problems are done (in ``OUT.done``). The same
command then goes on where it was stopped. Without ``--id``, OUT must not exist.
"""

import argparse
import os

import ray
from ray.data import ActorPoolStrategy, DataContext, SaveMode
from ray.data.checkpoint import CheckpointConfig

from kornia_pnpnet.arrow import Solve

#: Bytes of a block, which is what a worker gets at once and what is solved again when it dies: 180 000 problems of nine
#: pairs. With Ray's 128 MiB, few workers would have as much to do as the others.
BLOCK = 2**25


def solve(source: str, out: str, solver: str, *, workers: int, batch: int, id_column: str | None = None) -> None:
    """Solve problems of Parquet files, with the options of the command."""
    context = DataContext.get_current()
    context.target_max_block_size = BLOCK
    if id_column:
        place = out.rstrip("/") if "://" in out else os.path.abspath(out)  # a checkpoint takes no relative path
        context.checkpoint_config = CheckpointConfig(id_column, f"{place}.done", delete_checkpoint_on_success=False)
    poses = ray.data.read_parquet(source).map_batches(
        Solve,
        fn_constructor_kwargs={"solver": solver},
        batch_format="pyarrow",
        batch_size=batch,
        compute=ActorPoolStrategy(size=workers),
        num_cpus=0,  # Ray would wait forever if workers took all cores and left none to the tasks that read
    )
    poses.write_parquet(out, mode=SaveMode.APPEND if id_column else SaveMode.ERROR)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", metavar="IN")
    parser.add_argument("out", metavar="OUT")
    parser.add_argument("--solver", default="pnpnet-set")
    parser.add_argument("--workers", type=int, help="default: one for each core of the cluster")
    parser.add_argument("--batch-size", type=int, default=10_000)
    parser.add_argument("--id", metavar="NAME", help="column of unique numbers, to go on after a stop")
    options = parser.parse_args()
    ray.init()
    workers = options.workers or int(ray.cluster_resources()["CPU"])
    solve(options.source, options.out, options.solver, workers=workers, batch=options.batch_size, id_column=options.id)


if __name__ == "__main__":
    main()
