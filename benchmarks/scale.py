"""Very many problems with Ray Data beside a plain loop: ``python benchmarks/scale.py --problems 10000000``.

Draws problems of nine pairs into Parquet files. Solves them with ``pnpnet solve --batch`` and with
``docs/examples/ray_data.py``: a few problems (what the start costs), one worker, two workers, two workers of which one
is killed, and a run that is killed as a whole and repeated. Compares the results with those of the loop, problem by
problem. Writes ``scale.json``.
"""

import os
import shutil
import sys
import time
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pyarrow as pa
from harness import HERE, parser, say
from pyarrow import dataset, parquet

from kornia_pnpnet.arrow import list_column
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.files import write_json
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.results import source_digest

EXAMPLE = HERE.parent / "docs" / "examples" / "ray_data.py"
COMMAND = [sys.executable, "-c", "import sys; from kornia_pnpnet.cli import main; sys.exit(main())", "solve", "--batch"]
SOLVER, BATCH = "pnpnet-n9", 10_000
FOLDER = Path("outputs/scale")  # of the problems and the results
PAIRS, OUTLIERS = 9, 2
FILE = 250_000  # largest number of problems in a file
FEW = 1000  # problems of a run that is little more than the start of Ray
PERIOD = 0.5  # seconds between two measurements of the memory
WORKER = "MapBatches(Solve)"  # the title of a worker's process
POSE = ("rotation", "translation")
# The largest differences from a pose of the loop that count as rounding: entries of the rotation, and metres.
ROUNDING = 1e-3


def draw(folder: Path, problems: int) -> None:
    """Write problems with an ``id`` to Parquet files, unless they are there."""
    done = folder / "done"
    drawn_by = f"{problems} {source_digest()}"
    if done.exists() and done.read_text() == drawn_by:
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for i, start in enumerate(range(0, problems, FILE)):
        count = min(FILE, problems - start)
        source = SyntheticProblems(n=PAIRS, batch_size=count, seed=20_261_125, outliers=OutlierMix(count=OUTLIERS))
        drawn = dict(zip(("world_points", "img_points", "intrinsics"), source.batch(i)[:3], strict=True))
        lists = {name: list_column(x.float().numpy()) for name, x in drawn.items()}
        parquet.write_table(pa.table({"id": np.arange(start, start + count), **lists}), folder / f"{i:05}.parquet")
    done.write_text(drawn_by)


def run(command: list[str], kill_at: tuple[Path, int, str] | None = None) -> dict[str, Any]:
    """Run a command with one thread in each process; times and memory of all its processes together.

    ``kill_at``: a folder, a number of problems and a title. Once the folder has results of that number of problems, the
    first process whose title contains the text is killed; with an empty text all processes of the command.
    """
    say(" ".join(command[-8:]))
    start = time.perf_counter()
    killed, peak = None, 0
    cpu: dict[int, float] = {}
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "RAY_ADDRESS": "local"}
    with psutil.Popen(command, env=environment, stdout=sys.stderr) as process:
        while process.poll() is None:
            time.sleep(PERIOD)
            memory, victims = 0, []
            with suppress(psutil.NoSuchProcess):
                family = [process, *process.children(recursive=True)]
            for one in family:
                with suppress(psutil.NoSuchProcess):  # it has ended
                    memory += one.memory_full_info().pss  # memory that processes share is divided among them
                    spent = one.cpu_times()
                    cpu[one.pid] = spent.user + spent.system
                    victims += [one] if kill_at and kill_at[2] in " ".join(one.cmdline()) else []
            peak = max(peak, memory)
            if kill_at and killed is None and rows(kill_at[0]) >= kill_at[1]:
                killed = rows(kill_at[0])
                for one in victims[:1] if kill_at[2] else victims:
                    one.kill()
        wall = time.perf_counter() - start
    if kill_at and killed is None:
        raise RuntimeError("the command ended before a process could be killed")
    if process.returncode and not (kill_at and not kill_at[2]):
        raise RuntimeError(f"{' '.join(command)} failed")
    spent = {"wall_s": wall, "cpu_s": sum(cpu.values()), "peak_bytes": peak}
    return {**spent, "killed_at": killed, "load": os.getloadavg()[0]}


def rows(folder: Path) -> int:
    """Number of problems in the results files that are complete."""
    count = 0
    for path in folder.glob("*.parquet"):
        with suppress(pa.ArrowException, OSError):
            count += parquet.read_metadata(path).num_rows
    return count


def read(folder: Path) -> dict[str, np.ndarray]:
    """Results in the order of their ids, (B, …)."""
    table = dataset.dataset(folder, format="parquet").to_table(columns=["id", "ok", *POSE]).sort_by("id")
    poses = {name: table[name].combine_chunks().flatten().to_numpy().reshape(len(table), -1) for name in POSE}
    return {name: table[name].to_numpy() for name in ("id", "ok")} | poses


def compare(expected: dict[str, np.ndarray], folder: Path) -> dict[str, int]:
    """Counts of problems that are lost, twice there, or have another result."""
    found = read(folder)
    ids, first = np.unique(found["id"], return_index=True)
    at = np.searchsorted(expected["id"], ids)
    apart = np.maximum(*(np.abs(found[name][first] - expected[name][at]).max(1) for name in POSE))
    ok, expected_ok = found["ok"][first], expected["ok"][at]
    return {
        "lost": len(expected["id"]) - len(ids),
        "twice": len(found["id"]) - len(ids),
        "other_ok": int((ok != expected_ok).sum()),
        "same_bits": int((apart == 0).sum()),
        "beyond_rounding": int((ok & expected_ok & (apart > ROUNDING)).sum()),
    }


def measure(problems: int) -> dict[str, Any]:
    """Draw the problems, and solve them in all ways."""
    draw(FOLDER / "few", FEW)
    draw(FOLDER / "problems", problems)
    for name in ("start", "loop", "one", "two", "killed", "again", "again.done"):
        shutil.rmtree(FOLDER / name, ignore_errors=True)
    same = ["--solver", SOLVER, "--batch-size", str(BATCH)]

    def ray(name: str, workers: int, *more: str, source: str = "problems") -> list[str]:
        places = str(FOLDER / source), str(FOLDER / name)
        return [sys.executable, str(EXAMPLE), *places, *same, "--workers", str(workers), *more]

    third = problems // 3
    runs = {
        "start": run(ray("start", 2, source="few")),
        "loop": run([*COMMAND, str(FOLDER / "problems"), "--out", str(FOLDER / "loop"), *same]),
        "one": run(ray("one", 1)),
        "two": run(ray("two", 2)),
        "killed": run(ray("killed", 2), (FOLDER / "killed", third, WORKER)),
        "stopped": run(ray("again", 2, "--id", "id"), (FOLDER / "again", third, "")),
        "again": run(ray("again", 2, "--id", "id")),
    }
    expected = read(FOLDER / "loop")
    return {
        **{"problems": problems, "pairs": PAIRS, "solver": SOLVER, "batch": BATCH, "cores": os.cpu_count()},
        "ok": int(expected["ok"].sum()),
        "problem_bytes": sum(path.stat().st_size for path in (FOLDER / "problems").glob("*.parquet")),
        "result_bytes": sum(path.stat().st_size for path in (FOLDER / "loop").glob("*.parquet")),
        "runs": runs,
        "differences": {name: compare(expected, FOLDER / name) for name in ("one", "two", "killed", "again")},
    }


def main() -> None:
    """Measure, and write the results."""
    command = parser(__doc__, HERE / "scale.json")
    command.add_argument("--problems", type=int, default=1_000_000)
    options = command.parse_args()
    made, found = environment(), measure(options.problems)
    versions = {name: metadata.version(name) for name in ("ray", "pyarrow")}
    write_json(options.out, {"environment": made, "versions": versions, **found})


if __name__ == "__main__":
    main()
